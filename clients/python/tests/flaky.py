"""A network that breaks: a proxy that cuts each connection after some bytes."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable


class Flaky:
    """Forwards a free port of the loopback interface to another, and cuts connections.

    `budget` tells after how many bytes, of both directions together, the next connection is cut; `None`: never.
    """

    def __init__(self, target: tuple[str, int], budget: Callable[[], int | None]) -> None:
        self._target = target
        self._budget = budget
        self.cuts = 0
        self._open: list[socket.socket] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
                far = socket.create_connection(self._target)
            except OSError:
                return
            self._open += [near, far]
            left = [self._budget()]
            for one, other in ((near, far), (far, near)):
                threading.Thread(target=self._forward, args=(one, other, left), daemon=True).start()

    def _forward(self, one: socket.socket, other: socket.socket, left: list[int | None]) -> None:
        with contextlib.suppress(OSError):
            while data := one.recv(65536):
                if left[0] is not None:
                    data = data[: max(0, left[0])]
                    left[0] -= len(data)
                other.sendall(data)
                if left[0] is not None and left[0] <= 0:
                    self.cuts += 1
                    break
        for end in (one, other):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def stop(self) -> None:
        for end in (self._listener, *self._open):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()
