"""Height models are read from tiles; unusable files are refused with a cause and a remedy."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.errors import MapError
from cavmarl.maps.heights.height_model import HeightModel
from cavmarl.maps.heights.tile_files import read_tile
from tests.support.terrain import plane, write_geotiff, write_hgt

PLACES = np.array([[11.001, 48.001], [11.012, 48.009], [11.0071, 48.0033]])
GROUND = plane(0.03, 0.05)
NEW_YORK = (1024, 0, 1, 1, 1025, 0, 1, 2, 3072, 0, 1, 2263)  # projection of New York, in US feet
FEET = (1024, 0, 1, 2, 1025, 0, 1, 2, 2048, 0, 1, 4326, 4099, 0, 1, 9002)


@pytest.mark.parametrize("kind", [np.float32, np.int32, np.uint16])
def test_heights_are_read_from_geotiffs(tmp_path: Path, kind: type) -> None:
    model = HeightModel([write_geotiff(tmp_path / "g.tif", GROUND, kind=kind)])
    heights, coverage = model.at(PLACES)
    assert np.abs(heights - GROUND(*PLACES.T)).max() < (0.01 if kind is np.float32 else 1.1)
    assert coverage.filled_places == 0


def test_plain_and_zipped_hgt_files_have_equal_heights(tmp_path: Path) -> None:
    plain = write_hgt(tmp_path / "N48E011.hgt", GROUND)
    packed = tmp_path / "N48E011.hgt.zip"
    with zipfile.ZipFile(packed, "w") as archive:
        archive.write(plain, "N48E011.hgt")
    one, other = (HeightModel([path]).at(PLACES)[0] for path in (plain, packed))
    assert np.abs(one - GROUND(*PLACES.T)).max() < 1.1
    assert (one == other).all()


def test_a_real_hgt_file_and_its_crop_have_similar_heights(shared_maps: Path) -> None:
    random = np.random.default_rng(0)
    places = np.column_stack([random.uniform(7.41, 7.44, 500), random.uniform(43.73, 43.75, 500)])
    one = HeightModel([shared_maps / "dem" / "N43E007.hgt.zip"]).at(places)[0]
    other = HeightModel([shared_maps / "dem" / "monaco_srtm3.tif"]).at(places)[0]
    assert np.abs(one - np.maximum(other, -2.0)).max() < 3.0  # the crop has 0 for negative heights


def test_a_void_of_one_tile_gets_the_height_of_the_next_tile(tmp_path: Path) -> None:
    def hole(heights: NDArray[Any]) -> None:
        heights[40:60, 50:70] = np.nan

    first = write_geotiff(tmp_path / "first.tif", plane(0.0, 0.0, 500.0), holes=hole)
    second = write_geotiff(tmp_path / "second.tif", plane(0.0, 0.0, 700.0))
    # Row 50 and column 60 are at latitude 48.015 - 50 · 0.0002 and longitude 10.995 + 60 · 0.0002.
    places = np.array([[11.007, 48.005], [11.000, 48.000]])
    heights, coverage = HeightModel([first, second]).at(places)
    assert heights.tolist() == pytest.approx([700.0, 500.0])
    assert coverage.filled_places == 0
    heights, coverage = HeightModel([first]).at(places)
    assert heights.tolist() == pytest.approx([500.0, 500.0])
    assert coverage.filled_places == 1


def test_a_void_of_all_tiles_is_filled_from_the_surroundings_in_the_first_tile(
    tmp_path: Path,
) -> None:
    def hole(heights: NDArray[Any]) -> None:
        heights[40:60, 50:70] = np.nan

    tiles = [
        write_geotiff(tmp_path / f"{height}.tif", plane(0.0, 0.0, height), holes=hole)
        for height in (500.0, 700.0)
    ]
    places = np.array([[11.007, 48.005], [11.000, 48.000]])
    heights, coverage = HeightModel(tiles).at(places)
    assert heights.tolist() == pytest.approx([500.0, 500.0])
    assert coverage.filled_places == 1


def test_at_most_half_of_the_roads_may_be_in_voids(tmp_path: Path) -> None:
    def hole(heights: NDArray[Any]) -> None:
        heights[40:60, 50:70] = np.nan

    model = HeightModel([write_geotiff(tmp_path / "g.tif", plane(0.0, 0.0, 500.0), holes=hole)])
    void, known = [11.007, 48.005], [11.000, 48.000]
    assert model.at(np.array([void, void, known, known]))[1].filled_places == 2
    with pytest.raises(MapError, match="67% of the roads are in voids of the model; at most 50%"):
        model.at(np.array([void, void, known]))


def test_a_tile_covers_half_a_cell_beyond_its_outer_points(tmp_path: Path) -> None:
    model = HeightModel([write_geotiff(tmp_path / "g.tif", plane(0.0, 0.0, 500.0), step=0.0002)])
    west = 10.995
    heights, _ = model.at(np.array([[west - 0.00009, 48.0]]))
    assert heights.tolist() == [500.0]
    with pytest.raises(MapError, match="100% of the roads are outside of the model"):
        model.at(np.array([[west - 0.00011, 48.0]]))


def test_adjacent_tiles_form_one_model(tmp_path: Path) -> None:
    west = write_geotiff(tmp_path / "w.tif", GROUND, (10.995, 47.995, 11.006, 48.015))
    east = write_geotiff(tmp_path / "e.tif", GROUND, (11.006, 47.995, 11.02, 48.015))
    assert np.abs(HeightModel([west, east]).at(PLACES)[0] - GROUND(*PLACES.T)).max() < 0.05
    with pytest.raises(MapError, match=r"67% of the roads are outside of the model.*more tiles"):
        HeightModel([west]).at(PLACES)


def test_the_error_for_swapped_coordinates_says_that_they_look_swapped(tmp_path: Path) -> None:
    model = HeightModel([write_geotiff(tmp_path / "g.tif", GROUND)])
    with pytest.raises(MapError, match="look swapped"):
        model.at(PLACES[:, ::-1])


def test_a_tile_without_any_height_is_refused(tmp_path: Path) -> None:
    path = write_geotiff(tmp_path / "g.tif", GROUND, holes=lambda heights: heights.fill(np.nan))
    with pytest.raises(MapError, match="100% of the roads are in voids"):
        HeightModel([path]).at(PLACES)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ((), "no projection"),
        (FEET, "in feet"),
        (NEW_YORK, "in feet"),
        ((1024, 0, 1, 1, 3072, 0, 1, 32767), "no proj"),
    ],
)
def test_models_without_a_projection_in_metres_or_degrees_are_refused(
    tmp_path: Path, keys: tuple[int, ...], message: str
) -> None:
    with pytest.raises(MapError, match=message):
        read_tile(write_geotiff(tmp_path / "g.tif", GROUND, keys=keys))


def test_truncated_files_and_other_file_formats_are_refused(tmp_path: Path) -> None:
    whole = write_geotiff(tmp_path / "g.tif", GROUND)
    content = whole.read_bytes()
    for size in (8, 200, len(content) // 2, len(content) - 10):
        whole.write_bytes(content[:size])
        with pytest.raises(MapError, match=r"g\.tif"):
            read_tile(whole)
    hgt = write_hgt(tmp_path / "N48E011.hgt", GROUND)
    hgt.write_bytes(hgt.read_bytes()[:-7])
    with pytest.raises(MapError, match="truncated"):
        read_tile(hgt)
    with pytest.raises(MapError, match="rename it"):
        read_tile(write_hgt(tmp_path / "tile.hgt", GROUND))
    for name, text in (("x.tif", b"no heights"), ("x.zip", b"PK"), ("y.gz", b"\x1f\x8b\x08")):
        (tmp_path / name).write_bytes(text)
        with pytest.raises(MapError):
            read_tile(tmp_path / name)
    picture = write_geotiff(tmp_path / "p.tif", GROUND, kind=np.uint8)
    with pytest.raises(MapError, match="picture"):
        read_tile(picture)
