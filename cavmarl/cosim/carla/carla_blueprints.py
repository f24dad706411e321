"""The blueprints that clients can choose from, with CARLA's ids, attributes and default values.

Client programs choose recommended values of changeable attributes at random, so each changeable
attribute has at least one value.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

from cavmarl.sensors.kernels.panorama import BICYCLE, BUS, CAR, MOTORCYCLE, PEDESTRIAN, TRAM, TRUCK

WALKER, PROP = "pedestrian", "prop"  # values of `Blueprint.base_type` in addition to CARLA's

Kind = Literal["bool", "int", "float", "string", "colour"]

_KINDS: tuple[Kind, ...] = ("bool", "int", "float", "string", "colour")
_BOTH = ("true", "false")


@dataclass(frozen=True)
class BlueprintAttribute:
    """An attribute, its default value, and the values from which programs choose."""

    name: str
    kind: Kind
    default: str
    recommended: tuple[str, ...] = ()  # for attributes that can be changed; empty: the default
    can_change: bool = True


@dataclass(frozen=True)
class Blueprint:
    """A kind of actor that clients can spawn.

    `size_m`: length, width and height; zeros for sensors and controllers.
    """

    type_id: str
    attributes: tuple[BlueprintAttribute, ...]
    size_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def packed(self, number: int, first_kind: int) -> list[Any]:
        """Return the definition as it is sent; `first_kind`: code of bool, the first kind."""
        attributes = [
            [
                one.name,
                first_kind + _KINDS.index(one.kind),
                one.default,
                list(one.recommended or (one.default,)) if one.can_change else [],
                one.can_change,
                one.kind == "bool" and one.can_change,
            ]
            for one in self.attributes
        ]
        return [number, self.type_id, ",".join(reversed(self.type_id.split("."))), attributes]

    @property
    def base_type(self) -> str:
        """CARLA's base type of a vehicle (car, van, truck, bus, …), WALKER or PROP."""
        kinds = {"walker": WALKER, "static": PROP}
        return kinds.get(self.type_id.partition(".")[0]) or self.default("base_type")

    def default(self, name: str) -> str:
        """Return the default value of an attribute, or an empty text."""
        return next((one.default for one in self.attributes if one.name == name), "")


def _fixed(name: str, kind: Kind, value: str) -> BlueprintAttribute:
    return BlueprintAttribute(name, kind, value, can_change=False)


def _floats(**defaults: float) -> tuple[BlueprintAttribute, ...]:
    return tuple(BlueprintAttribute(name, "float", str(value)) for name, value in defaults.items())


def _ints(**defaults: int) -> tuple[BlueprintAttribute, ...]:
    return tuple(BlueprintAttribute(name, "int", str(value)) for name, value in defaults.items())


_COLOURS = ("17,37,103", "255,255,255", "180,44,44", "0,0,0", "107,162,146", "137,0,0")


def _vehicle(
    type_id: str,
    base_type: str,
    size_m: tuple[float, float, float],
    wheels: int = 4,
    special_type: str = "",
) -> Blueprint:
    return Blueprint(
        f"vehicle.{type_id}",
        (
            BlueprintAttribute(
                "role_name", "string", "autopilot", ("autopilot", "scenario", "ego_vehicle")
            ),
            BlueprintAttribute("color", "colour", _COLOURS[0], _COLOURS),
            BlueprintAttribute("driver_id", "int", "0", ("0",)),
            BlueprintAttribute("sticky_control", "bool", "true", _BOTH),
            BlueprintAttribute("terramechanics", "bool", "false", _BOTH),
            _fixed("number_of_wheels", "int", str(wheels)),
            _fixed("object_type", "string", ""),
            _fixed("base_type", "string", base_type),
            _fixed("special_type", "string", special_type),
            _fixed("generation", "int", "2"),
            _fixed("has_lights", "bool", "true"),
            _fixed("has_dynamic_doors", "bool", "false"),
        ),
        size_m,
    )


def _walker(number: int, age: str, gender: str) -> Blueprint:
    return Blueprint(
        f"walker.pedestrian.{number:04d}",
        (
            BlueprintAttribute("role_name", "string", "pedestrian"),
            BlueprintAttribute("is_invincible", "bool", "true", _BOTH),
            BlueprintAttribute("speed", "float", "1.4", ("0.0", "1.4", "2.6")),
            BlueprintAttribute("use_wheelchair", "bool", "false", _BOTH),
            _fixed("can_use_wheelchair", "bool", "false"),
            _fixed("age", "string", age),
            _fixed("gender", "string", gender),
            _fixed("generation", "int", "2"),
        ),
        (0.38, 0.38, 1.86),
    )


def _prop(name: str, *size_m: float) -> Blueprint:
    length, width, height = size_m
    largest_m = max(size_m)
    sizes = ((0.4, "tiny"), (1.0, "small"), (2.5, "medium"), (math.inf, "big"))
    size = next(text for limit_m, text in sizes if largest_m <= limit_m)
    return Blueprint(
        f"static.prop.{name}",
        (BlueprintAttribute("role_name", "string", "prop"), _fixed("size", "string", size)),
        (length, width, height),
    )


def _sensor(type_id: str, *attributes: BlueprintAttribute) -> Blueprint:
    common = (
        BlueprintAttribute("role_name", "string", "front"),
        BlueprintAttribute("sensor_tick", "float", "0.0"),
        BlueprintAttribute("ros_name", "string", type_id.rpartition(".")[2]),
    )
    return Blueprint(f"sensor.{type_id}", (*common, *attributes))


_CAMERA = (
    *_ints(image_size_x=800, image_size_y=600),
    *_floats(
        fov=90.0,
        lens_circle_falloff=5.0,
        lens_circle_multiplier=0.0,
        lens_k=-1.0,
        lens_kcube=0.0,
        lens_x_size=0.08,
        lens_y_size=0.08,
    ),
)
_RGB = (
    *_CAMERA,
    *_floats(
        bloom_intensity=0.675,
        fstop=1.4,
        iso=100.0,
        gamma=2.2,
        lens_flare_intensity=0.1,
        shutter_speed=200.0,
        min_fstop=1.2,
        exposure_compensation=0.0,
        exposure_min_bright=10.0,
        exposure_max_bright=12.0,
        exposure_speed_up=3.0,
        exposure_speed_down=1.0,
        calibration_constant=16.0,
        focal_distance=1000.0,
        blur_amount=1.0,
        blur_radius=0.0,
        motion_blur_intensity=0.45,
        motion_blur_max_distortion=0.35,
        motion_blur_min_object_screen_size=0.1,
        slope=0.88,
        toe=0.55,
        shoulder=0.26,
        black_clip=0.0,
        white_clip=0.04,
        temp=6500.0,
        tint=0.0,
        chromatic_aberration_intensity=0.0,
        chromatic_aberration_offset=0.0,
    ),
    *_ints(blade_count=5),
    BlueprintAttribute("exposure_mode", "string", "histogram", ("histogram", "manual")),
    BlueprintAttribute("enable_postprocess_effects", "bool", "true", _BOTH),
)
_LIDAR = (
    *_ints(channels=32, points_per_second=56000),
    *_floats(
        range=10.0,
        rotation_frequency=10.0,
        upper_fov=10.0,
        lower_fov=-30.0,
        horizontal_fov=360.0,
    ),
)
_LIDAR_NOISE = _floats(
    atmosphere_attenuation_rate=0.004,
    dropoff_general_rate=0.45,
    dropoff_intensity_limit=0.8,
    dropoff_zero_intensity=0.4,
    noise_stddev=0.0,
)
_SEED = _ints(noise_seed=0)
_GNSS = _floats(
    noise_alt_bias=0.0,
    noise_alt_stddev=0.0,
    noise_lat_bias=0.0,
    noise_lat_stddev=0.0,
    noise_lon_bias=0.0,
    noise_lon_stddev=0.0,
)
_IMU = _floats(
    **{
        f"noise_{what}_{axis}": 0.0
        for what in ("accel_stddev", "gyro_bias", "gyro_stddev")
        for axis in "xyz"
    }
)

# Length, width and height in m; typical sizes of such objects.
_PROPS = {
    "atm": (0.9, 0.7, 2.0),
    "barrel": (0.6, 0.6, 0.9),
    "bench01": (0.6, 1.8, 0.9),
    "bench02": (0.6, 1.6, 0.9),
    "bin": (0.6, 0.6, 1.1),
    "box01": (0.6, 0.6, 0.5),
    "box02": (0.5, 0.5, 0.4),
    "box03": (0.4, 0.4, 0.3),
    "busstop": (1.8, 4.0, 2.6),
    "chainbarrier": (0.2, 1.5, 1.0),
    "clothcontainer": (1.2, 1.2, 1.9),
    "constructioncone": (0.35, 0.35, 0.6),
    "container": (1.4, 2.2, 1.6),
    "creasedbox01": (0.5, 0.5, 0.3),
    "creasedbox02": (0.5, 0.5, 0.3),
    "creasedbox03": (0.5, 0.5, 0.3),
    "dirtdebris01": (1.5, 1.5, 0.1),
    "dirtdebris02": (1.5, 1.5, 0.1),
    "dirtdebris03": (1.5, 1.5, 0.1),
    "foodcart": (1.5, 2.5, 2.2),
    "garbage01": (0.4, 0.4, 0.2),
    "garbage02": (0.4, 0.4, 0.2),
    "garbage03": (0.4, 0.4, 0.2),
    "glasscontainer": (1.2, 1.2, 1.8),
    "haybale": (1.2, 0.8, 0.8),
    "kiosk_01": (2.5, 2.5, 2.8),
    "mailbox": (0.6, 0.6, 1.3),
    "plantpot01": (0.9, 0.9, 0.9),
    "plasticbag": (0.5, 0.5, 0.4),
    "plasticchair": (0.6, 0.6, 0.9),
    "plastictable": (1.0, 1.0, 0.8),
    "shoppingcart": (1.0, 0.6, 1.0),
    "streetbarrier": (0.4, 1.2, 1.1),
    "streetsign": (0.2, 0.8, 2.2),
    "table": (1.6, 0.9, 0.8),
    "trafficcone01": (0.4, 0.4, 0.9),
    "trafficcone02": (0.4, 0.4, 0.9),
    "trafficwarning": (1.3, 2.0, 2.6),
    "trashbag": (0.6, 0.6, 0.5),
    "trashcan01": (0.7, 0.7, 1.1),
    "trashcan02": (0.7, 0.7, 1.1),
    "travelcase": (0.5, 0.3, 0.7),
    "vendingmachine": (0.9, 1.1, 2.0),
    "warningaccident": (0.4, 0.8, 0.9),
    "warningconstruction": (0.4, 0.8, 0.9),
    "wateringcan": (0.4, 0.2, 0.3),
}
_CHILDREN = (9, 10, 11, 12, 13, 14, 48, 49)  # numbers of the walkers that are children
# Programs look these up, but cavmarl's server refuses to spawn them.
_OTHER_CAMERAS = (
    "camera.normals",
    "camera.dvs",
    "camera.cosmos_visualization",
)
UNAVAILABLE = frozenset(f"sensor.{name}" for name in _OTHER_CAMERAS)

BLUEPRINTS = {
    blueprint.type_id: blueprint
    for blueprint in (
        _vehicle("tesla.model3", "car", (4.79, 2.16, 1.49), special_type="electric"),
        _vehicle("audi.a2", "car", (3.71, 1.79, 1.55)),
        _vehicle("audi.etron", "car", (4.86, 2.03, 1.65), special_type="electric"),
        _vehicle("audi.tt", "car", (4.18, 1.99, 1.39)),
        _vehicle("bmw.grandtourer", "car", (4.61, 2.24, 1.67)),
        _vehicle("chevrolet.impala", "car", (5.36, 2.03, 1.41)),
        _vehicle("citroen.c3", "car", (3.99, 1.85, 1.62)),
        _vehicle("dodge.charger_2020", "car", (5.01, 1.88, 1.54)),
        _vehicle("dodge.charger_police", "car", (4.97, 2.04, 1.55), special_type="emergency"),
        _vehicle("dodge.charger_police_2020", "car", (5.24, 2.03, 1.64), special_type="emergency"),
        _vehicle("ford.crown", "car", (5.37, 1.8, 1.58), special_type="taxi"),
        _vehicle("ford.mustang", "car", (4.72, 1.89, 1.3)),
        _vehicle("jeep.wrangler_rubicon", "car", (3.87, 1.91, 1.88)),
        _vehicle("lincoln.mkz_2017", "car", (4.9, 2.06, 1.48)),
        _vehicle("lincoln.mkz_2020", "car", (4.89, 1.84, 1.49)),
        _vehicle("mercedes.coupe", "car", (5.03, 2.15, 1.64)),
        _vehicle("mercedes.coupe_2020", "car", (4.67, 1.82, 1.42)),
        _vehicle("micro.microlino", "car", (2.21, 1.48, 1.38), special_type="electric"),
        _vehicle("mini.cooper_s", "car", (3.81, 1.97, 1.48)),
        _vehicle("mini.cooper_s_2021", "car", (4.55, 2.1, 1.77)),
        _vehicle("nissan.micra", "car", (3.63, 1.85, 1.5)),
        _vehicle("nissan.patrol", "car", (4.6, 1.93, 1.86)),
        _vehicle("nissan.patrol_2021", "car", (5.57, 2.15, 2.05)),
        _vehicle("seat.leon", "car", (4.19, 1.82, 1.47)),
        _vehicle("toyota.prius", "car", (4.51, 2.01, 1.52), special_type="electric"),
        _vehicle("ford.ambulance", "van", (6.36, 2.35, 2.43), special_type="emergency"),
        _vehicle("mercedes.sprinter", "van", (5.92, 1.99, 2.56)),
        _vehicle("volkswagen.t2", "van", (4.48, 2.07, 2.04)),
        _vehicle("volkswagen.t2_2021", "van", (4.44, 1.77, 1.99)),
        _vehicle("carlamotors.carlacola", "truck", (5.2, 2.61, 2.47)),
        _vehicle("carlamotors.european_hgv", "truck", (7.94, 2.89, 3.46)),
        _vehicle("carlamotors.firetruck", "truck", (8.47, 2.89, 3.83), special_type="emergency"),
        _vehicle("tesla.cybertruck", "truck", (6.27, 2.39, 2.1), special_type="electric"),
        _vehicle("mitsubishi.fusorosa", "bus", (10.27, 3.94, 4.25)),
        _vehicle("harley-davidson.low_rider", "motorcycle", (2.35, 0.76, 1.48), wheels=2),
        _vehicle("kawasaki.ninja", "motorcycle", (2.04, 0.8, 1.45), wheels=2),
        _vehicle("vespa.zx125", "motorcycle", (1.81, 0.87, 1.23), wheels=2),
        _vehicle("yamaha.yzf", "motorcycle", (2.21, 0.87, 1.25), wheels=2),
        _vehicle("bh.crossbike", "bicycle", (1.51, 0.86, 1.62), wheels=2),
        _vehicle("diamondback.century", "bicycle", (1.65, 0.37, 1.59), wheels=2),
        _vehicle("gazelle.omafiets", "bicycle", (1.83, 0.45, 1.76), wheels=2),
        *(
            _walker(
                number,
                "child" if number in _CHILDREN else "adult",
                "female" if number % 2 else "male",
            )
            for number in range(1, 53)
        ),
        *(_prop(name, *size_m) for name, size_m in _PROPS.items()),
        Blueprint("controller.ai.walker", (BlueprintAttribute("role_name", "string", "default"),)),
        _sensor("camera.rgb", *_RGB),
        _sensor("camera.depth", *_CAMERA),
        _sensor("camera.semantic_segmentation", *_CAMERA),
        _sensor("camera.instance_segmentation", *_CAMERA),
        _sensor("camera.optical_flow", *_CAMERA),
        _sensor("lidar.ray_cast", *_LIDAR, *_LIDAR_NOISE, *_SEED),
        _sensor("lidar.ray_cast_semantic", *_LIDAR),
        _sensor(
            "other.radar",
            *_floats(horizontal_fov=30.0, vertical_fov=30.0, range=100.0),
            *_ints(points_per_second=1500),
            *_SEED,
        ),
        _sensor("other.gnss", *_GNSS, *_SEED),
        _sensor("other.imu", *_IMU, *_SEED),
        _sensor("other.collision"),
        _sensor("other.lane_invasion"),
        *(_sensor(name, *_CAMERA) for name in _OTHER_CAMERAS),
        _sensor(
            "other.obstacle",
            *_floats(distance=5.0, hit_radius=0.5),
            BlueprintAttribute("only_dynamics", "bool", "false", _BOTH),
            BlueprintAttribute("debug_linetrace", "bool", "false", _BOTH),
        ),
    )
}

# The blueprint of vehicles that no client has spawned, by their class in semantic pictures.
BLUEPRINT_OF_CLASS = {
    CAR: "vehicle.tesla.model3",
    TRUCK: "vehicle.carlamotors.carlacola",
    BUS: "vehicle.mitsubishi.fusorosa",
    TRAM: "vehicle.mitsubishi.fusorosa",
    MOTORCYCLE: "vehicle.kawasaki.ninja",
    BICYCLE: "vehicle.diamondback.century",
    PEDESTRIAN: "walker.pedestrian.0001",
}
