"""A cache of decoded pixels with a limit in bytes; what was used least recently is dropped first."""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from threading import Lock

from torch import Tensor


class PixelCache:
    """Keep what was made under a key until `limit` bytes are full.

    What is asked for twice at the same time may be made twice; what comes back is the same either way.

    Args:
        limit: Bytes that all kept tensors may take together; one that is larger is made anew each time.

    Example:
        >>> import torch
        >>> cache = PixelCache(limit=8)
        >>> cache.get("a", lambda: torch.zeros(2)) is cache.get("a", lambda: torch.ones(2))
        True
    """

    def __init__(self, limit: int):
        self.limit = limit
        self.used = 0
        self._kept: OrderedDict[Hashable, Tensor] = OrderedDict()
        self._lock = Lock()

    def get(self, key: Hashable, make: Callable[[], Tensor]) -> Tensor:
        """What `make` returned when `key` was last made. It is shared: do not write into it."""
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
        value = make()
        self._keep(key, value)
        return value

    def _keep(self, key: Hashable, value: Tensor) -> None:
        if value.nbytes > self.limit:
            return
        with self._lock:
            if key in self._kept:
                return
            self._kept[key] = value
            self.used += value.nbytes
            while self.used > self.limit:
                _, evicted = self._kept.popitem(last=False)
                self.used -= evicted.nbytes
