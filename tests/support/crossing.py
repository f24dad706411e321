"""A crossing small enough to check by hand."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

# Roads from west to east with a pavement, from south to north, and a right turn from the south.
CROSSING = """<?xml version="1.0" encoding="UTF-8"?>
<net version="1.20">
  <location netOffset="0,0" convBoundary="0,0,0,0" origBoundary="0,0,0,0" projParameter="!"/>
  <edge id=":c_0" function="internal">
    <lane id=":c_0_0" index="0" speed="10" length="10" shape="-5,0 5,0"/>
  </edge>
  <edge id=":c_1" function="internal">
    <lane id=":c_1_0" index="0" speed="10" length="10" shape="0,-5 0,-5 0,5"/>
  </edge>
  <edge id=":c_2" function="internal">
    <lane id=":c_2_0" index="0" speed="5" length="3" shape="0,-5 1,-2"/>
  </edge>
  <edge id=":c_3" function="internal">
    <lane id=":c_3_0" index="0" speed="5" length="4" shape="1,-2 5,0"/>
  </edge>
  <edge id="w" from="W" to="c">
    <lane id="w_0" index="0" allow="pedestrian" speed="10" length="95" shape="-100,-3 -5,-3"/>
    <lane id="w_1" index="1" speed="10" length="95" shape="-100,0 -50,0 -50,0 -5,0"/>
    <lane id="w_2" index="2" allow="bus" speed="10" length="95" shape="-100,3 -5,3"/>
  </edge>
  <edge id="s" from="S" to="c">
    <lane id="s_0" index="0" speed="10" length="95" shape="0,-100 0,-5"/>
  </edge>
  <edge id="e" from="c" to="E">
    <lane id="e_0" index="0" speed="10" length="95" shape="5,0,0 100,0,19"/>
  </edge>
  <edge id="n" from="c" to="N">
    <lane id="n_0" index="0" speed="10" length="95" shape="0,5 0,100"/>
  </edge>
  <tlLogic id="c" type="static" programID="0" offset="3">
    <phase duration="30" state="Grr"/>
    <phase duration="4" state="yrr"/>
    <phase duration="26" state="rGg"/>
  </tlLogic>
  <junction id="W" type="dead_end" x="-100" y="0" incLanes="" intLanes="" shape=""/>
  <junction id="S" type="dead_end" x="0" y="-100" incLanes="" intLanes="" shape=""/>
  <junction id="E" type="dead_end" x="100" y="0" incLanes="e_0" intLanes="" shape=""/>
  <junction id="N" type="dead_end" x="0" y="100" incLanes="n_0" intLanes="" shape=""/>
  <junction id="c" type="traffic_light" x="0" y="0" incLanes="w_1 s_0"
            intLanes=":c_0_0 :c_1_0 :c_3_0" shape="">
    <request index="0" response="000" foes="110" cont="0"/>
    <request index="1" response="001" foes="001" cont="0"/>
    <request index="2" response="001" foes="001" cont="1"/>
  </junction>
  <junction id=":c_3_0" type="internal" x="1" y="-2" incLanes=":c_2_0" intLanes=":c_0_0"/>
  <connection from="w" to="e" fromLane="1" toLane="0" via=":c_0_0"
              tl="c" linkIndex="0" dir="s" state="O"/>
  <connection from="s" to="n" fromLane="0" toLane="0" via=":c_1_0"
              tl="c" linkIndex="1" dir="s" state="o"/>
  <connection from="s" to="e" fromLane="0" toLane="0" via=":c_2_0"
              tl="c" linkIndex="2" dir="r" state="o"/>
  <connection from=":c_0" to="e" fromLane="0" toLane="0" dir="s" state="M"/>
  <connection from=":c_1" to="n" fromLane="0" toLane="0" dir="s" state="M"/>
  <connection from=":c_2" to="e" fromLane="0" toLane="0" via=":c_3_0" dir="r" state="m"/>
  <connection from=":c_3" to="e" fromLane="0" toLane="0" dir="r" state="M"/>
</net>
"""


@pytest.fixture
def crossing(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that writes the crossing with replaced text: `crossing(("old", "new"))`."""

    def write(*changes: tuple[str, str]) -> Path:
        text = CROSSING
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / "crossing.net.xml"
        path.write_text(text, encoding="utf-8")
        return path

    return write
