"""A terrain model: tiles of heights, evaluated at longitudes and latitudes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MapError, require
from cavmarl.maps.heights.tile_files import WGS84, Grid, HeightTile, read_tile

_MOST_FILLED = 0.5  # maximum share of evaluated places that are filled


@dataclass(frozen=True)
class Coverage:
    """The coverage of evaluated places by a model."""

    places: int
    # places between cells without a height, interpolated from neighbours
    filled_places: int
    void_cells: int  # number of filled cells in the used parts of tiles
    cells: int  # number of cells in these parts

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


class HeightModel:
    """Tiles of heights; where tiles overlap, the first tile with a height is used."""

    def __init__(self, paths: Sequence[str | Path]) -> None:
        """Read the tiles; raises MapError if a file cannot be used, see `read_tile`."""
        self.tiles = [read_tile(Path(path)) for path in paths]
        self.cell_m = min(map(_cell_m, self.tiles))

    def at(self, degrees: NDArray[np.float64]) -> tuple[NDArray[np.float64], Coverage]:
        """Return heights in m (n,) at longitudes and latitudes (n, 2), interpolated linearly.

        Raises:
            MapError: a place is outside of the tiles, or too many places have no height.
            MissingExtraError: pyproj is not installed.
        """
        heights = np.full(len(degrees), np.nan)
        filled = np.zeros(len(degrees), bool)
        cells = void_cells = 0
        for tile in self.tiles:
            asked = np.flatnonzero(np.isnan(heights) | filled)
            row, column, inside = _cells_of(tile, degrees[asked])
            asked, row, column = asked[inside], row[inside], column[inside]
            if not len(asked):
                continue
            part, row, column = _cut(tile.heights_m, row, column)
            void = np.isnan(part)
            known = _bilinear(np.where(void, 0.0, 1.0), row, column) > 1.0 - 1e-9
            better = known | np.isnan(heights[asked])
            if void.all():
                continue
            found = _bilinear(_filled(part), row, column)
            heights[asked[better]] = found[better]
            filled[asked[better]] = ~known[better]
            cells, void_cells = cells + part.size, void_cells + int(void.sum())
        self._check(degrees, heights, filled)
        return heights, Coverage(len(degrees), int(filled.sum()), void_cells, cells)

    def _check(
        self, degrees: NDArray[np.float64], heights: NDArray[np.float64], filled: NDArray[np.bool_]
    ) -> None:
        names = ", ".join(tile.name for tile in self.tiles)
        off = np.ones(len(degrees), bool)
        for tile in self.tiles:
            off &= ~_cells_of(tile, degrees)[2]
        if off.any():
            west, south = degrees.min(axis=0)
            east, north = degrees.max(axis=0)
            swapped = any(_cells_of(tile, degrees[:, ::-1])[2].any() for tile in self.tiles)
            hint = "; longitude and latitude look swapped in the map or model" if swapped else ""
            raise MapError(
                f"{names}: {off.mean():.0%} of the roads are outside of the model (they reach from "
                f"longitude {west:.4f} to {east:.4f}, latitude {south:.4f} to {north:.4f}){hint}: "
                "give more tiles (--dem again), or crop the map (--bbox)"
            )
        unknown = np.isnan(heights) | filled
        if np.isnan(heights).any() or unknown.mean() > _MOST_FILLED:
            raise MapError(
                f"{names}: {unknown.mean():.0%} of the roads are in voids of the model; at most "
                f"{_MOST_FILLED:.0%} can be filled: give another model"
            )


def _cell_m(tile: HeightTile) -> float:
    degrees = tile.crs == WGS84 or abs(tile.dy) < 0.1
    return abs(tile.dy) * (111_320.0 if degrees else 1.0)


def _cells_of(
    tile: HeightTile, degrees: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return fractional rows and columns of places, and whether they are on the tile."""
    x, y = degrees[:, 0], degrees[:, 1]
    if tile.crs != WGS84:
        pyproj: Any = require("pyproj", "maps")
        try:
            motion = pyproj.Transformer.from_crs(WGS84, tile.crs, always_xy=True)
        except pyproj.exceptions.CRSError as error:
            raise MapError(f"{tile.name}: {tile.crs} is unknown ({error}): warp it") from error
        x, y = motion.transform(x, y)
    column, row = (x - tile.x0) / tile.dx, (y - tile.y0) / tile.dy
    rows, columns = tile.heights_m.shape
    edge = 0.5 + 1e-6  # half a cell around the centres of the outer cells
    inside = (column >= -edge) & (column <= columns - 1 + edge)
    inside &= (row >= -edge) & (row <= rows - 1 + edge)
    return np.clip(row, 0.0, rows - 1), np.clip(column, 0.0, columns - 1), inside


def _cut(
    grid: Grid, row: NDArray[np.float64], column: NDArray[np.float64]
) -> tuple[Grid, NDArray[np.float64], NDArray[np.float64]]:
    """Return the part of a grid around some places, and their positions in it."""
    margin = 16
    top, left = max(int(row.min()) - margin, 0), max(int(column.min()) - margin, 0)
    part = grid[top : int(row.max()) + margin + 2, left : int(column.max()) + margin + 2]
    return part, row - top, column - left


def _bilinear(grid: Grid, row: NDArray[np.float64], column: NDArray[np.float64]) -> Grid:
    top = np.minimum(row.astype(np.int64), grid.shape[0] - 2).clip(0)
    left = np.minimum(column.astype(np.int64), grid.shape[1] - 2).clip(0)
    down, right = row - top, column - left
    below, beside = np.minimum(top + 1, grid.shape[0] - 1), np.minimum(left + 1, grid.shape[1] - 1)
    upper = grid[top, left] * (1.0 - right) + grid[top, beside] * right
    lower = grid[below, left] * (1.0 - right) + grid[below, beside] * right
    result: Grid = upper * (1.0 - down) + lower * down
    return result


def _filled(grid: Grid) -> Grid:
    """Return a grid without voids, filled with means of known cells from coarser grids."""
    void = np.isnan(grid)
    if not void.any():
        return grid
    rows, columns = (size + size % 2 for size in grid.shape)
    padded = np.full((rows, columns), np.nan)
    padded[: grid.shape[0], : grid.shape[1]] = grid
    blocks = padded.reshape(rows // 2, 2, columns // 2, 2)
    count = (~np.isnan(blocks)).sum(axis=(1, 3))
    total = np.nansum(blocks, axis=(1, 3))
    coarse = _filled(np.where(count > 0, total / np.maximum(count, 1), np.nan))
    row = (np.arange(grid.shape[0]) - 0.5) / 2.0
    column = (np.arange(grid.shape[1]) - 0.5) / 2.0
    at_row, at_column = np.meshgrid(
        row.clip(0, coarse.shape[0] - 1), column.clip(0, coarse.shape[1] - 1), indexing="ij"
    )
    guess = _bilinear(coarse, at_row.ravel(), at_column.ravel()).reshape(grid.shape)
    return np.where(void, guess, grid)
