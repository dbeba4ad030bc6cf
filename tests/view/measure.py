"""How fast the viewer is in a real browser: `python -m tests.view.measure RUN`.

Times of a browser on this machine, until a picture has arrived in it. Its graphics are drawn on the same CPU, which a user's are not. CPU is the server's.
"""

import argparse
import io
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from PIL import Image

from tests.browser import launched, watched
from tests.view.serving import Serving, serving

_START = b"\xff\xd8\xff"
"""Of a JPEG file."""
_PANEL = 324
"""Width of the controls beside the picture."""
_TICK = 20
"""Milliseconds between looks at what has arrived, and between movements of the mouse."""


@dataclass
class Arrivals:
    """Pictures that have come through a page's socket."""

    times: list[float] = field(default_factory=list)
    sizes: list[tuple[int, int]] = field(default_factory=list)

    def listen(self, page: Any) -> None:
        """Note every picture of a page that is yet to be opened."""
        page.on("websocket", lambda socket: socket.on("framereceived", self._note))

    def _note(self, message: Any) -> None:
        import zstandard  # pyright: ignore[reportMissingImports]  (viser brings it)

        if not isinstance(message, bytes):
            return
        now, length = time.monotonic(), int.from_bytes(message[8:16], "little")
        plain = zstandard.ZstdDecompressor().decompress(message[16 : 16 + length])
        at = plain.find(_START)
        if at >= 0:
            self.times.append(now)
            self.sizes.append(Image.open(io.BytesIO(plain[at:])).size)


@dataclass(frozen=True)
class Took:
    """One measurement."""

    seconds: float
    cpu: float


def cpu_of(server: Serving) -> float:
    """Seconds that the server has worked."""
    fields = Path(f"/proc/{server.process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def wait_for_picture(page: Any, arrived: Arrivals, count: int) -> float:
    """When there are so many."""
    until = time.monotonic() + 60
    while len(arrived.times) < count and time.monotonic() < until:
        page.wait_for_timeout(_TICK)
    return arrived.times[count - 1]


def rest(page: Any, server: Serving) -> None:
    """Until the server does nothing more."""
    before = -1.0
    while (now := cpu_of(server)) - before > 0.02:
        before = now
        page.wait_for_timeout(700)


def first_picture(page: Any, arrived: Arrivals, server: Serving) -> Took:
    """From the address to the first picture."""
    cpu, began = cpu_of(server), time.monotonic()
    page.goto(server.url)
    return Took(wait_for_picture(page, arrived, 1) - began, cpu_of(server) - cpu)


def word(page: Any, arrived: Arrivals, server: Serving, name: str) -> Took:
    """From Enter to the answer."""
    rest(page, server)
    area = page.locator("textarea").first
    area.fill(name)
    page.wait_for_timeout(300)
    count, cpu, began = len(arrived.times), cpu_of(server), time.monotonic()
    area.press("Enter")
    return Took(wait_for_picture(page, arrived, count + 1) - began, cpu_of(server) - cpu)


def moving(page: Any, arrived: Arrivals, server: Serving, seconds: float) -> tuple[Took, str]:
    """From one picture to the next while the mouse turns the camera, and their sizes."""
    rest(page, server)
    page.mouse.move(200, 200)
    page.mouse.down()
    first, cpu, began, step = len(arrived.times), cpu_of(server), time.monotonic(), 0
    while time.monotonic() - began < seconds:
        step += 1
        page.mouse.move(200 + 2 * (step % 100), 200 + step % 50)
        page.wait_for_timeout(_TICK)
    count = len(arrived.times) - first
    took = Took((time.monotonic() - began) / max(count, 1), (cpu_of(server) - cpu) / max(count, 1))
    page.mouse.up()
    widths, heights = zip(*arrived.sizes[first:], strict=True)
    return took, f"median size {median(widths):.0f}x{median(heights):.0f}"


def take(page: Any, server: Serving, path: Path) -> None:
    """A picture of the window at rest, without what viser says of a browser that has no GPU."""
    for button in page.locator("button.mantine-Notification-closeButton").all():
        button.click()
    page.mouse.move(200, 200)
    rest(page, server)
    page.screenshot(path=path)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print; the load of the machine stands beside the figures."""
    parser = argparse.ArgumentParser(prog="python -m tests.view.measure", description=__doc__)
    parser.add_argument("run", type=Path, metavar="RUN")
    parser.add_argument("--words", nargs="+", default=["mug", "lemon", "orange", "wall"])
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480), metavar=("W", "H"))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument(
        "--screenshot", type=Path, metavar="OUT.png", help="the window after the last word"
    )
    args = parser.parse_args(arguments)
    width, height = args.size
    firsts, words, moves, note = list[Took](), list[Took](), list[Took](), ""
    load = os.getloadavg()[0]
    with serving(str(args.run)) as server, launched() as browser:
        for _ in range(args.repeats):
            with watched(browser, width + _PANEL, height) as (page, _):
                arrived = Arrivals()
                arrived.listen(page)
                firsts.append(first_picture(page, arrived, server))
                took, note = moving(page, arrived, server, 4.0)
                moves.append(took)
                words += [word(page, arrived, server, name) for name in args.words]
                if args.screenshot is not None:
                    take(page, server, args.screenshot)
    print(f"{args.run}, {width}x{height}, load {load:.1f} before, medians:")
    say("first picture after the address", firsts)
    say("a picture while the mouse moves", moves, note)
    say("a word, from Enter to the picture", words)


def say(what: str, taken: Sequence[Took], note: str = "") -> None:
    """One line of figures."""

    def middle(of: Callable[[Took], float]) -> float:
        return 1000 * median(map(of, taken))

    print(
        f"{what}: {middle(lambda t: t.seconds):.0f} ms, CPU {middle(lambda t: t.cpu):.0f} ms {note}"
    )


if __name__ == "__main__":
    main()
