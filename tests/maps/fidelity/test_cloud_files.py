from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.core.errors import CapacityError, MapError
from cavmarl.maps.fidelity import cloud_files
from cavmarl.maps.fidelity.cloud_files import read_cloud

POINTS = np.array([(1.0, 2.0, 3.0), (-4.5, 5.25, 6.0), (7.0, -8.0, 0.125)])
PLY = "ply\nformat ascii 1.0\nelement vertex"
XYZ = "property float x\nproperty float y\nproperty float z\nend_header\n"


def ply(path: Path, order: str = "<") -> None:
    kind = np.dtype([("x", f"{order}f8"), ("tag", "u1"), ("y", f"{order}f4"), ("z", f"{order}f4")])
    rows = np.zeros(3, kind)
    rows["x"], rows["y"], rows["z"] = POINTS.T
    name = {"<": "little", ">": "big"}[order]
    head = f"ply\nformat binary_{name}_endian 1.0\ncomment made\nelement vertex 3\n"
    head += "property double x\nproperty uchar tag\nproperty float y\nproperty float z\n"
    head += "element face 0\nproperty list uchar int vertex_index\nend_header\n"
    path.write_bytes(head.encode() + rows.tobytes())


def ascii_ply(path: Path) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
    rows = "\n".join(" ".join(map(str, row)) for row in POINTS.tolist())
    path.write_text(f"{head}property float z\nend_header\n{rows}\n")


def las(path: Path) -> None:
    laspy: Any = pytest.importorskip("laspy", reason="needs the extra 'maps'")
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales = np.full(3, 0.001)
    header.offsets = np.array([1.0, 2.0, 3.0])
    data = laspy.LasData(header)
    data.x, data.y, data.z = POINTS.T
    data.write(str(path))


def pcd(path: Path, encoding: str = "binary_compressed") -> None:
    pypcd4: Any = pytest.importorskip("pypcd4", reason="needs the extra 'maps'")
    cloud = pypcd4.PointCloud.from_xyz_points(POINTS.astype(np.float32))
    cloud.save(path, encoding=pypcd4.Encoding(encoding))


def text(content: str) -> Callable[[Path], Any]:
    return lambda path: path.write_text(content)


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("a.csv", text("x,y,z\n1,2,3\n-4.5,5.25,6\n7,-8,0.125\n")),
        ("b.csv", text("intensity;z;y;x\n9;3;2;1\n9;6;5.25;-4.5\n9;0.125;-8;7\n")),
        ("c.xyz", text("# scan\n\n1 2 3 255\n -4.5\t5.25 6 255\n7 -8 0.125 255\n")),
        ("d.ply", ply),
        ("e.ply", lambda path: ply(path, ">")),
        ("f.ply", ascii_ply),
        ("g.pcd", pcd),
        ("h.pcd", lambda path: pcd(path, "ascii")),
        ("i.pcd", lambda path: pcd(path, "binary")),
        ("j.las", las),
        ("k.laz", las),
    ],
)
def test_each_file_format_gives_the_same_points(
    tmp_path: Path, name: str, write: Callable[[Path], Any]
) -> None:
    write(tmp_path / name)
    cloud = read_cloud(tmp_path / name)
    assert cloud.points == pytest.approx(POINTS, abs=1e-9)
    assert cloud.counts == {"read": 3, "no numbers": 0}


def test_invalid_points_are_dropped_and_counted(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x,y,z\n1,2,3\nnan,2,3\n1,inf,3\n4,5,6\n")
    cloud = read_cloud(tmp_path / "a.csv")
    assert len(cloud.points) == 2
    assert cloud.counts == {"read": 4, "no numbers": 2}


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.csv", "", "has no points"),
        ("a.csv", "x,y,z\n", "has no points"),
        ("a.csv", "x,y,z\nnan,nan,nan\n", "all 1 points are NaN"),
        ("a.csv", "a,b,c\n1,2,3\n", "line 1: the header has no columns x, y and z"),
        ("a.csv", "x,y,z\n1,2,3\n1,2\n", "needs three numbers"),
        ("a.csv", "x,y,z\n1,2,three\n", "needs three numbers"),
        ("a.ply", "x,y,z\n1,2,3\n", "does not match '.ply'"),
        ("a.ply", "ply\nformat ascii 1.0\nend_header\n", "no number of vertices"),
        ("a.ply", f"{PLY} {'9' * 5000}\n{XYZ}", "no number of vertices"),
        ("a.ply", f"{PLY} 1\nproperty float x\n{XYZ}", "have the same name"),
        ("a.ply", f"{PLY} 0\n{XYZ}", "has no points"),
        ("a.ply", f"{PLY} 3\n{XYZ}\n\n\n", "0 of 3 points"),
        ("a.las", "LASF", "not a complete las"),
        ("a.laz", "<html>", "does not match '.laz'"),
        ("a.pcd", "# .PCD v0.7\nVERSION 0.7\nPOINTS 9\n", "not a complete pcd"),
        ("a.tif", "II*", "does not match '.tif'"),
        ("none.csv", None, "cannot be read"),
    ],
)
def test_a_file_without_a_point_cloud_is_refused(
    tmp_path: Path, name: str, content: str | None, words: str
) -> None:
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(MapError, match=words):
        read_cloud(tmp_path / name)


@pytest.mark.parametrize(("name", "write"), [("a.ply", ply), ("a.pcd", pcd), ("a.las", las)])
def test_truncated_files_are_refused(
    tmp_path: Path, name: str, write: Callable[[Path], Any]
) -> None:
    path = tmp_path / name
    write(path)
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(MapError, match=r"truncated|not a complete"):
        read_cloud(path)


def test_files_with_too_many_points_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cloud_files, "MOST_POINTS", 2)
    for name, write in (("a.ply", ply), ("a.las", las), ("a.pcd", pcd)):
        write(tmp_path / name)
        with pytest.raises(CapacityError, match="3 points, more than 2: thin it out"):
            read_cloud(tmp_path / name)
    (tmp_path / "a.csv").write_text("1,2,3\n" * 3)
    with pytest.raises(CapacityError, match="more than 2"):
        read_cloud(tmp_path / "a.csv")
