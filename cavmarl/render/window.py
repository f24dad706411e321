"""A window on the screen for `render_mode="human"`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from cavmarl.render.canvas import load_pygame

if TYPE_CHECKING:
    from pygame import Surface


class Window:
    """Shows pictures at a steady pace; opens at the first one.

    When the person at the screen closes it, the run goes on unseen.

    `fps`: pictures a second; `show` waits for its turn.
    """

    def __init__(self, title: str, fps: float) -> None:
        self.title = title
        self.fps = fps
        self.closed_by_person = False
        self._window: Any = None
        self._clock: Any = None

    def show(self, surface: Surface) -> None:
        """Put a picture on the screen and handle what the person did since the last one."""
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
