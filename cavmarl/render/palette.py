"""The colours of all pictures, red green blue: a quiet map, so that the agents stand out."""

from __future__ import annotations

Color = tuple[int, int, int]

LAND: Color = (235, 237, 230)
KERB: Color = (205, 208, 200)
ASPHALT: Color = (98, 107, 119)
PATH: Color = (212, 211, 203)  # lanes that are closed to cars
MARKING: Color = (214, 219, 224)
CENTRE_LINE: Color = (226, 206, 150)

BACKGROUND_CAR: Color = (186, 204, 225)
ACTOR: Color = (250, 232, 120)  # follows a script
GLASS: Color = (48, 58, 72)
HEADLIGHT: Color = (255, 250, 225)
BRAKE: Color = (255, 56, 48)
BLINKER: Color = (255, 178, 36)
COLLIDED: Color = (222, 22, 34)

# Alternating hues, so that agents with neighbouring numbers differ most.
AGENTS: tuple[Color, ...] = (
    (255, 127, 14),
    (30, 144, 255),
    (236, 64, 122),
    (46, 184, 92),
    (255, 202, 40),
    (149, 97, 226),
    (0, 188, 212),
    (244, 81, 60),
    (156, 204, 40),
    (205, 92, 190),
)

# Of zones and their vehicles; zones that touch seldom have the same. They are those of M. Okabe and
# K. Ito, Color Universal Design (2008), which people with any colour vision can tell apart.
ZONES: tuple[Color, ...] = (
    (0, 114, 178),
    (230, 159, 0),
    (0, 158, 115),
    (204, 121, 167),
    (213, 94, 0),
    (86, 180, 233),
    (240, 228, 66),
)

# By signal code, the positions in roads.network.SIGNAL_STATES = "rugGysoOY".
SIGNALS: tuple[Color, ...] = (
    (232, 58, 52),
    (245, 132, 42),
    (88, 196, 116),
    (38, 208, 98),
    (250, 204, 56),
    (150, 110, 220),
    (224, 190, 120),
    (170, 176, 182),
    (250, 204, 56),
)

PANEL: Color = (252, 252, 250)
INK: Color = (44, 52, 62)
MUTED_INK: Color = (112, 120, 130)


def agent_color(agent: int) -> Color:
    return AGENTS[agent % len(AGENTS)]


def zone_color(zone: int) -> Color:
    return ZONES[zone % len(ZONES)]


def ink_on(color: Color) -> Color:
    """Dark or light ink, whichever reads better (luma of ITU-R BT.601)."""
    luma = 0.299 * color[0] + 0.587 * color[1] + 0.114 * color[2]
    return INK if luma > 140 else PANEL
