"""The web server and the controls on the screen: the one module that knows viser."""

import io
import time
from collections.abc import Sequence
from dataclasses import replace
from threading import Lock
from typing import TYPE_CHECKING

import rich
from PIL import Image

from vlgs.names import file_names
from vlgs.opened import NamedCamera
from vlgs.text import markdown
from vlgs.view.address import Address, in_use, require_free
from vlgs.view.eye import Eye, Surroundings, eye_of, surroundings
from vlgs.view.save import answering_ply
from vlgs.view.session import Frame, Session, describe
from vlgs.view.shown import Shown
from vlgs.view.wish import ASKING, LAYOUTS, OUTPUTS, Wish
from vlgs.view.worker import Stage, Worker

if TYPE_CHECKING:
    import viser  # pyright: ignore[reportMissingImports]

_QUALITY = {Stage.COARSE: 75, Stage.SHARP: 92, Stage.EXACT: 92}
"""Of JPEG."""
_LABEL = "vlgs"
_BEST = "best"
_NO_CAMERA = "-"
_READING = 0.5
"""Seconds that a line stands at least while the camera moves."""
_LARGEST = 4096
"""Pixels along a side of a picture; a larger window is filled by fewer."""
_HISTORY = 12
"""Words that are remembered before those that the scene knows."""


class Server:
    """Serves runs to browsers until it is stopped.

    Args:
        runs: One or two; who holds the list may replace them.
        address: Where to listen; port 0 is any that is free.
        word: Asked for as soon as a browser comes.

    Raises:
        OSError: If that cannot be: the port is in use, or the host is not this machine.
    """

    def __init__(self, runs: list[Shown], address: Address, word: str | None = None) -> None:
        import viser  # an optional package; the command says which extra brings it

        require_free(address)
        self.runs = runs
        self.word = word
        self.cameras = list(runs[0].run.cameras())
        self.around = surroundings([one.camera for one in self.cameras])
        rich.reconfigure(quiet=True)  # what viser announces, the command says in its own words
        self._viser = viser.ViserServer(address.host, address.port, _LABEL, verbose=False)
        self.worker = Worker()
        self.address = Address(address.host, self._viser.get_port())
        if address.port not in (0, self.address.port):
            self.stop()  # viser takes the next port where one is taken in between
            raise in_use(address, "taken by another program")
        # A page behind a public address of another company is no part of "this machine only".
        self._viser.request_share_url = _share_nothing
        self._viser.gui.configure_theme(show_share_button=False)
        self._viser.gui.main_panel.dock_right()
        self._begin_at(runs[0].run.held_out()[0])
        self._viser.on_client_connect(self._connected)
        self._viser.on_client_disconnect(self._disconnected)

    def stop(self) -> None:
        """End all drawing and close the port."""
        self.worker.stop()
        self._viser.stop()

    def _begin_at(self, first: NamedCamera) -> None:
        """Where a browser looks from when it comes."""
        camera, start = first.camera, self._viser.initial_camera
        self._viser.scene.set_up_direction(_three(self.around.up))
        # Wide, so that the height of the photograph decides.
        eye = eye_of(camera, 2 * camera.width, camera.height)
        start.position, start.fov = _three(eye.position), eye.fov
        start.look_at, start.up = (
            _three(self.around.look_at(camera)),
            _three(self.around.up_of(camera)),
        )

    async def _connected(self, client: "viser.ClientHandle") -> None:
        # In the loop of events, so that a browser's events come one after the other.
        panel = _Panel(client, self.runs, self.worker, self.cameras, self.around)
        panel.begin()
        if self.word is not None:
            panel.ask(self.word)

    async def _disconnected(self, client: "viser.ClientHandle") -> None:
        self.worker.close(client.client_id)


class _Panel:
    """The controls of one browser, and what it wishes."""

    def __init__(
        self,
        client: "viser.ClientHandle",
        runs: list[Shown],
        worker: Worker,
        cameras: Sequence[NamedCamera],
        around: Surroundings,
    ) -> None:
        self.client = client
        self.runs = runs
        self.worker = worker
        self.cameras = {f"{one.split} {one.name}": one for one in cameras}
        self.around = around
        self.session = Session(runs, self._send, self._complain)
        self.wish = Wish(_eye_of(client.camera))
        self.history: list[str] = []
        self._said = 0.0
        self._changing = Lock()
        self._add_controls()

    def begin(self) -> None:
        """Draw the first picture, and one for every movement."""
        self.worker.open(self.client.client_id, self.session)

        async def moved(camera: "viser.CameraHandle") -> None:
            self._wish(moving=True, eye=_eye_of(camera))

        self.client.camera.on_update(moved)
        self._wish(moving=True)

    def _add_controls(self) -> None:
        gui, first = self.client.gui, self.runs[0]
        outputs = [one for one in OUTPUTS if any(one in run.outputs for run in self.runs)]
        asks = any(output in ASKING for output in outputs)
        # Several lines, as Enter is then a letter: viser sends one message in 50 ms and forgets all but the last, so that the
        # Enter of a form would take the place of the last letters of a word that is typed fast.
        self.word = gui.add_text("Word", "", multiline=True, visible=asks, hint="Enter asks for it")
        self.known = gui.add_dropdown(
            "Known words", self._known(), visible=asks, hint="asked before, or of the scene"
        )
        self.output = gui.add_dropdown("Show", outputs)
        levels = first.run.levels
        self.level = gui.add_dropdown(
            "Mask level", [_BEST, *map(str, levels)], visible=asks and len(levels) > 1
        )
        self.share = gui.add_slider(
            "Threshold", 0.0, 1.0, 0.01, self.wish.share, visible=asks,
            hint="of the mask: how far up in the word's range of relevancy over the scene",
        )  # fmt: skip
        self.opacity = gui.add_slider(
            "Opacity", 0.0, 1.0, 0.01, self.wish.opacity, visible=asks, hint="of what is painted"
        )
        self.camera = gui.add_dropdown(
            "Photograph", [_NO_CAMERA, *self.cameras], hint="look from where it was taken"
        )
        two = len(self.runs) > 1
        self.layout = gui.add_dropdown("Two runs", LAYOUTS, initial_value=LAYOUTS[two], visible=two)
        self.division = gui.add_slider("Division", 0.0, 1.0, 0.01, 0.5, visible=two)
        self.picture = gui.add_button("Save picture", hint="PNG of what is shown")
        self.gaussians = gui.add_button(
            "Save Gaussians", hint="PLY of those of the first run that answer the word",
            visible=first.run.field.has_language and first.gaussians is not None,
        )  # fmt: skip
        self.status = gui.add_markdown("")
        self.message = gui.add_markdown("")
        self.wish = replace(self.wish, layout=LAYOUTS[two], output=outputs[0])
        self._listen()

    def _listen(self) -> None:
        """What happens when a control is touched. Callbacks run in threads; what takes long disturbs nobody."""
        self.word.on_update(lambda _: self._typed())
        self.known.on_update(lambda _: self.ask(self.known.value))
        self.output.on_update(lambda _: self._wish(output=self.output.value))
        self.level.on_update(lambda _: self._wish(level=_number(self.level.value)))
        self.share.on_update(lambda _: self._wish(share=self.share.value))
        self.opacity.on_update(lambda _: self._wish(opacity=self.opacity.value))
        self.layout.on_update(lambda _: self._wish(layout=self.layout.value))
        self.division.on_update(lambda _: self._wish(division=self.division.value))
        self.camera.on_update(lambda _: self._jump(self.camera.value))
        self.picture.on_click(lambda _: self._save_picture())
        self.gaussians.on_click(lambda _: self._save_gaussians())

    def _wish(self, moving: bool = False, **changes: object) -> None:
        with self._changing:
            self.wish = replace(self.wish, **changes)
            self.worker.ask(self.client.client_id, self.wish, moving)

    def _typed(self) -> None:
        text = self.word.value
        if "\n" in text:
            self.word.value = " ".join(text.split())
            self.ask(self.word.value)

    def ask(self, word: str) -> None:
        """Encode a word and show where it is; what is wrong with it is said on the screen."""
        word = word.strip()
        if not word or word == _NO_CAMERA or word == self.wish.word:
            return
        try:
            notes = {run.learn(word).note for run in self.runs if run.run.field.has_language}
        except (ValueError, OSError) as error:
            self._complain(str(error))
            return
        self.message.content = markdown(" ".join(sorted(notes - {""})))
        self.history = [word, *(one for one in self.history if one != word)][:_HISTORY]
        output = self.wish.output if self.wish.output in ASKING else ASKING[0]
        self._wish(word=word, output=output)
        self.word.value, self.output.value = word, output
        self.known.options = self._known()
        self.known.value = word

    def _known(self) -> tuple[str, ...]:
        notes = self.runs[0].run.notes
        words = notes.classes or (notes.vocabulary.names if notes.vocabulary else ())
        first = () if self.history else (_NO_CAMERA,)
        return tuple(dict.fromkeys([*first, *self.history, *words]))

    def _jump(self, name: str) -> None:
        """Look from a photograph's camera; the browser then says that it moved."""
        if name not in self.cameras:
            return
        found, camera = self.cameras[name].camera, self.client.camera
        eye = eye_of(found, camera.image_width, camera.image_height)
        with self.client.atomic():
            camera.position = _three(eye.position)
            camera.look_at = _three(self.around.look_at(found))
            camera.up_direction = _three(self.around.up_of(found))
            camera.fov = eye.fov

    def _send(self, frame: Frame) -> None:
        """Called by the worker, in its thread."""
        pixels = frame.picture.pixels.numpy()
        self.client.scene.set_background_image(
            pixels, format="jpeg", jpeg_quality=_QUALITY[frame.stage]
        )
        now = time.monotonic()
        if frame.stage is not Stage.COARSE or now - self._said > _READING:
            self._said = now
            lines = describe(self.runs, self.wish, frame)
            self.status.content = "  \n".join(map(markdown, lines))
        self.client.flush()

    def _complain(self, reason: str) -> None:
        self.message.content = f"**error:** {markdown(reason)}"

    def _save_picture(self) -> None:
        wish, stream = self.wish, io.BytesIO()
        try:
            with self.worker.alone:
                picture = self.session.full(wish)
        except ValueError as error:
            self._complain(str(error))
            return
        Image.fromarray(picture.pixels.numpy()).save(stream, "PNG")
        shown = wish.word if wish.word and wish.output in ASKING else wish.output
        self._download(f"{shown}.png", stream.getvalue())

    def _save_gaussians(self) -> None:
        wish = self.wish
        try:
            with self.worker.alone:
                content, count = answering_ply(self.runs[0], wish)
        except ValueError as error:
            self._complain(str(error))
            return
        self.message.content = f"{count:,} Gaussians saved"
        self._download(f"{wish.word}.ply", content)

    def _download(self, name: str, content: bytes) -> None:
        safe = file_names([name])[name]
        self.client.send_file_download(safe, content, save_immediately=True)


def _eye_of(camera: "viser.CameraHandle") -> Eye:
    w, h = max(int(camera.image_width), 1), max(int(camera.image_height), 1)
    scale = min(_LARGEST / max(w, h), 1.0)
    return Eye(
        tuple(map(float, camera.position)),
        tuple(map(float, camera.wxyz)),
        float(camera.fov),
        max(round(scale * w), 1),
        max(round(scale * h), 1),
    )


def _number(level: str) -> int | None:
    return None if level == _BEST else int(level)


def _three(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = values
    return x, y, z


def _share_nothing(verbose: bool = True) -> None:
    del verbose
