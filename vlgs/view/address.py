"""Where the viewer listens."""

import socket
from dataclasses import dataclass


@dataclass(frozen=True)
class Address:
    """Where the viewer listens."""

    host: str
    port: int

    @property
    def url(self) -> str:
        """What to open in a browser on this machine."""
        host = "localhost" if self.host in ("0.0.0.0", "::", "") else self.host
        return f"http://[{host}]:{self.port}" if ":" in host else f"http://{host}:{self.port}"


def require_free(address: Address) -> None:
    """Refuse a port that cannot be listened on; viser would look for another one, or wait for ever.

    Raises:
        OSError: Says why.
    """
    try:
        found = socket.getaddrinfo(
            address.host, address.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )
        for family, kind, protocol, _, place in found:
            with socket.socket(family, kind, protocol) as one:
                one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                one.bind(place)
    except OSError as error:
        raise in_use(address, error.strerror or str(error)) from error


def in_use(address: Address, why: str) -> OSError:
    """What to raise where an address cannot be had."""
    return OSError(
        f"view: port {address.port} of {address.host} must be free, got: {why}; --port takes another one, 0 any that is free"
    )
