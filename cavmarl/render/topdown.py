"""`TopDownRenderer`: pictures of a world from above.

`WorldView` implements `CavEnv.render()`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError
from cavmarl.core.records.codes import DRIVER_SCRIPTED
from cavmarl.engine.simulation import Simulation
from cavmarl.handoff.zone_view import ZoneView
from cavmarl.render.canvas import load_pygame, pixels
from cavmarl.render.cars import draw_cars, in_view
from cavmarl.render.ground import draw_ground, draw_stop_lines
from cavmarl.render.overlay import Overlay, Sample, clock_text, samples_of_drivers, samples_of_zones
from cavmarl.render.shapes import road_shapes
from cavmarl.render.viewport import Bounds, Viewport, suitable_size
from cavmarl.render.zone_overlay import draw_sight, draw_transfers, draw_zones, owner_paints
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.shown_signals import signal_codes

if TYPE_CHECKING:
    from pygame import Surface


class Window:
    """A window that shows pictures at a steady rate and opens at the first picture.

    When the user closes the window, the run continues without it.

    `fps`: pictures per second; `show` waits accordingly.
    """

    def __init__(self, title: str, fps: float) -> None:
        self.title = title
        self.fps = fps
        self.closed_by_person = False
        self._window: Any = None
        self._clock: Any = None

    def show(self, surface: Surface) -> None:
        """Show a picture and handle the user's input since the last one."""
        if self.closed_by_person:
            return
        pygame = load_pygame()
        if self._window is None:
            pygame.display.init()
            self._window = pygame.Window(self.title, surface.get_size())
            self._clock = pygame.time.Clock()
        self._window.get_surface().blit(surface, (0, 0))
        self._window.flip()
        self._clock.tick(self.fps)
        for event in pygame.event.get():
            if event.type in (pygame.QUIT, pygame.WINDOWCLOSE):
                self.close()
                self.closed_by_person = True
                return

    def close(self) -> None:
        if self._window is not None:
            self._window.destroy()
            self._window = None


# A camera that follows vehicles or a place: its smallest visible extent; and the share of the
# distance to them that it covers per picture.
FOLLOW_M = 150.0
FOLLOW_SHARE = 0.12
MARGIN_PX = 50.0  # margin for the overlays in the corners
STILL_DETAIL = 4  # factor by which the ground is drawn larger, then reduced
MOVING_DETAIL = 2  # the same while the camera follows vehicles


class TopDownRenderer:
    """Draws the vehicles and signals of one map, off screen.

    `size`: width and height of the picture in pixels; by default derived from the map's shape.
    `focus`: (min_x, min_y, max_x, max_y) in metres to show; by default all roads or, if there are
    several maps, the roads of the vehicles' map. `goal_edges`: EDGE rows (M, G) by MAP row and
    `VEHICLE["goal"]`; if given, each agent's destination is marked.

    Raises MissingExtraError: pygame-ce is not installed.
    """

    def __init__(
        self,
        network: RoadNetwork,
        size: tuple[int, int] | None = None,
        focus: Bounds | None = None,
        goal_edges: NDArray[np.int32] | None = None,
    ) -> None:
        load_pygame()
        self.network = network
        bounds = focus or network.extent_of(0)
        self._moves_home = focus is None and len(network.maps) > 1
        self.size = size or suitable_size(bounds)
        self._home = Viewport.fit(bounds, self.size, MARGIN_PX)
        self._camera = self._home
        self._following = False
        self._goals = None if goal_edges is None else _edge_ends(network, goal_edges)
        self._shapes = road_shapes(network)
        self._overlay = Overlay()
        self._ground: tuple[Viewport, Surface] | None = None
        self._scene: tuple[Viewport, bytes, Surface] | None = None
        self._window: Window | None = None

    @property
    def camera(self) -> Viewport:
        return self._camera

    def draw(
        self,
        vehicles: NDArray[np.void],
        signal_phases: NDArray[np.int32] | None = None,
        *,
        title: str = "",
        clock_s: float | None = None,
        follow: Sequence[int] | None = None,
        center: tuple[float, float] | None = None,
        zones: ZoneView | None = None,
        ghosts_of: int | None = None,
    ) -> Surface:
        """Draw one picture.

        Args:
            vehicles: VEHICLE rows, in any order.
            signal_phases: (num_signals,) present PHASE rows; by default no signal is shown.
            title: text for the upper left corner.
            clock_s: time for the upper left corner.
            follow: agents, by index, that the camera follows; it stays still while none of them is
                in the world. By default it shows `focus`.
            center: (x, y) in metres that the camera follows, instead of agents.
            zones: zones of a divided world; vehicles get the colours of their owners. `vehicles`
                must then be all vehicles of the world, as from `Simulation.vehicles`.
            ghosts_of: zone whose sensing range and ghosts are outlined.

        Returns:
            a new surface; see `frame` for an array.
        """
        self._aim(vehicles, follow, center)
        camera = self._camera
        surface = self._background(signal_phases).copy()
        notes = [] if clock_s is None else [clock_text(clock_s)]
        notes.append(f"{len(vehicles)} vehicles")
        if zones is None:
            samples = self._draw_drivers(surface, vehicles)
        else:
            samples = self._draw_owners(surface, vehicles, zones, ghosts_of)
            notes += [f"{zones.partition.count} zones", f"{len(zones.transfers)} in transfer"]
        self._overlay.title(surface, title, "   ".join(notes))
        self._overlay.scale_bar(surface, camera)
        self._overlay.legend(surface, samples)
        return surface

    def _draw_drivers(self, surface: Surface, vehicles: NDArray[np.void]) -> list[Sample]:
        """Draw vehicles by driver, and agents with their numbers and destinations."""
        camera = self._camera
        seen = in_view(vehicles, camera)
        if self._goals is not None:
            agents = vehicles[vehicles["agent"] >= 0]
            maps = self.network.lanes["map"][agents["lane"]]
            self._overlay.destinations(
                surface, agents["agent"], self._goals[maps, agents["goal"]], camera
            )
        draw_cars(surface, seen, camera)
        self._overlay.agents(surface, seen, camera)
        actors = bool((vehicles["driver"] == DRIVER_SCRIPTED).any())
        return samples_of_drivers(destinations=self._goals is not None, actors=actors)

    def _draw_owners(
        self, surface: Surface, vehicles: NDArray[np.void], zones: ZoneView, ghosts_of: int | None
    ) -> list[Sample]:
        """Draw zones, and vehicles by present and next owner and by the zones that see them."""
        camera = self._camera
        draw_zones(surface, zones.partition, zones.halo_m, camera)
        if ghosts_of is not None:
            draw_sight(surface, zones.partition, zones.halo_m, ghosts_of, camera)
        seen = in_view(vehicles, camera)
        draw_cars(surface, seen, camera, owner_paints(zones, vehicles, seen, ghosts_of))
        draw_transfers(surface, zones, vehicles, camera)
        return samples_of_zones(zones.partition.count, ghosts_of)

    def frame(self, *args: Any, **named: Any) -> NDArray[np.uint8]:
        """Return the picture of `draw` as uint8 (height, width, 3) in red, green, blue."""
        return pixels(self.draw(*args, **named))

    def show(self, surface: Surface, title: str, fps: float) -> None:
        """Show a picture of `draw` in a window, at least 1/`fps` s after the last one."""
        if self._window is None:
            self._window = Window(title, fps)
        self._window.show(surface)

    @property
    def closed_by_person(self) -> bool:
        """Return whether the user has closed the window."""
        return self._window is not None and self._window.closed_by_person

    def close(self) -> None:
        """Close the window and free all pictures; drawing again recreates them."""
        if self._window is not None:
            self._window.close()
            self._window = None
        self._ground = None
        self._scene = None

    def _aim(
        self,
        vehicles: NDArray[np.void],
        follow: Sequence[int] | None,
        center: tuple[float, float] | None,
    ) -> None:
        if self._moves_home and len(vehicles):
            number = int(self.network.lanes["map"][vehicles["lane"][0]])
            self._home = Viewport.fit(self.network.extent_of(number), self.size, MARGIN_PX)
        if follow is None and center is None:
            self._camera, self._following = self._home, False
            return
        if center is not None:
            places = np.array([center], dtype=np.float64)
        else:
            rows = vehicles[np.isin(vehicles["agent"], follow or ())]
            places = np.stack([rows["x"], rows["y"]], axis=1)
        if len(places):
            share = FOLLOW_SHARE if self._following else 1.0
            self._camera = self._camera.towards(self._closeup(places), share)
            self._following = True

    def _closeup(self, places: NDArray[np.float64]) -> Viewport:
        low, high = places.min(axis=0), places.max(axis=0)
        middle = (low + high) / 2.0
        half = np.maximum((high - low) * 0.6, FOLLOW_M / 2.0)
        (min_x, min_y), (max_x, max_y) = (middle - half).tolist(), (middle + half).tolist()
        return Viewport.fit((min_x, min_y, max_x, max_y), self.size)

    def _background(self, signal_phases: NDArray[np.int32] | None) -> Surface:
        """Return roads and stop lines, redrawn if the camera has moved or a signal has changed."""
        camera = self._camera
        if self._ground is None or self._ground[0] != camera:
            detail = MOVING_DETAIL if self._following else STILL_DETAIL
            self._ground = camera, draw_ground(self._shapes, camera, detail)
        if signal_phases is None or not len(self.network.signals):
            return self._ground[1]
        codes = signal_codes(self.network, signal_phases)
        key = codes.tobytes()
        if self._scene is None or self._scene[:2] != (camera, key):
            scene = self._ground[1].copy()
            draw_stop_lines(scene, self._shapes, codes, camera)
            self._scene = camera, key, scene
        return self._scene[2]


def _edge_ends(network: RoadNetwork, edges: NDArray[np.int32]) -> NDArray[np.float64]:
    """Return the end (…, 2) in m of each edge (…): the mean of its lanes' last points."""
    ends = np.zeros((*edges.shape, 2))
    for row, edge in np.ndenumerate(network.edges[edges]):
        first = edge["first_lane"]
        lanes = range(first, first + edge["num_lanes"])
        ends[row] = np.mean([network.lane_polyline(lane)[-1, :2] for lane in lanes], axis=0)
    return ends


class WorldView:
    """Renders one world of a simulation from above, into arrays or into a window.

    Args:
        simulation: the worlds.
        mode: `rgb_array` or `human`.
        title: title of the picture and of the window.
        fps: pictures per second of the window.

    Raises:
        MissingExtraError: pygame-ce is not installed.
    """

    def __init__(self, simulation: Simulation, mode: str, title: str, fps: int) -> None:
        self._simulation = simulation
        self._mode = mode
        self._title = title
        self._fps = fps
        self._renderer = TopDownRenderer(simulation.network, goal_edges=simulation.goal_edges)

    def show(self, ghosts_of: int | None = None, world: int = 0) -> NDArray[np.uint8] | None:
        """Render the present state: (height, width, 3) in mode `rgb_array`, None in mode `human`.

        A divided world is drawn with its zones, and with vehicles in the colours of their owners.

        Args:
            ghosts_of: zone whose sensing range and ghosts are outlined.
            world: index of the simulation's world.

        Raises:
            ConfigError: the world has no such zone.
        """
        simulation = self._simulation
        count = simulation.partition.count
        if ghosts_of is not None and not 0 <= ghosts_of < count:
            raise ConfigError(f"ghosts_of = {ghosts_of}: the world has the zones 0 to {count - 1}")
        picture = self._renderer.draw(
            simulation.vehicles(world),
            simulation.signal_phases(world),
            title=self._title,
            clock_s=float(simulation.ticks()[world]) * simulation.config.clock.sim_dt_s,
            zones=simulation.zones.view(world) if count > 1 else None,
            ghosts_of=ghosts_of,
        )
        if self._mode == "rgb_array":
            return pixels(picture)
        self._renderer.show(picture, self._title, self._fps)
        return None

    def close(self) -> None:
        self._renderer.close()
