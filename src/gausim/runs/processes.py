"""Processes that end with the one that started them, however that one ends."""

import os
import threading
import time

# Exit status of a process that SIGTERM ended, as shells report it.
EXIT_TERMINATED = 143
_INTERVAL = 0.5


def end_with(parent: int) -> None:
    """Has this process end when its parent, of this process id, is no more: a killed parent ends nothing itself."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_INTERVAL)
        os._exit(EXIT_TERMINATED)

    threading.Thread(target=watch, daemon=True, name="end_with_parent").start()
