"""Pictures as an MP4 file that every browser plays (H.264, by PyAV)."""

import io
from fractions import Fraction
from pathlib import Path

from jaxtyping import UInt8
from torch import Tensor
from torch.nn.functional import pad

from vlgs.extras import require_extra
from vlgs.files import write_atomically


class Video:
    """A video that is written whole, when all frames are there, or not at all.

    Args:
        path: The file.
        fps: Frames a second.
        quality: H.264's constant rate factor: 18 looks like the pictures, 23 is half as large.

    Raises:
        ValueError: If PyAV is not installed.
    """

    def __init__(self, path: Path, fps: float, quality: int = 18) -> None:
        require_extra("av", "video")
        import av  # pyright: ignore[reportMissingImports]

        self.path = path
        self.buffer = io.BytesIO()
        self.container = av.open(self.buffer, "w", format="mp4")
        rate = Fraction(fps).limit_denominator(1000)
        self.stream = self.container.add_stream("libx264", rate=rate)
        self.stream.options = {"crf": str(quality)}
        self.stream.pix_fmt = "yuv420p"
        self.size: tuple[int, int] | None = None

    def add(self, picture: UInt8[Tensor, "h w 3"]) -> None:
        """The next frame; colour is kept for 2 x 2 pixels, so that an odd side is made even by repeating its last pixels.

        Raises:
            ValueError: If it has another size than the first.
        """
        import av  # pyright: ignore[reportMissingImports]

        h, w = picture.shape[:2]
        if self.size is None:
            self.size = (h, w)
            self.stream.width, self.stream.height = w + w % 2, h + h % 2
        if (h, w) != self.size:
            raise ValueError(
                f"video: pictures must be of one size, {self.size[1]} x {self.size[0]}, got {w} x {h}"
            )
        planes = pad(picture.permute(2, 0, 1)[None].float(), (0, w % 2, 0, h % 2), mode="replicate")
        even = planes[0].permute(1, 2, 0).to(picture.dtype).contiguous()
        frame = av.VideoFrame.from_ndarray(even.numpy(), format="rgb24")
        self.container.mux(self.stream.encode(frame))

    def close(self) -> None:
        """Write the file.

        Raises:
            OSError: If it cannot be written.
        """
        self.container.mux(self.stream.encode(None))
        self.container.close()
        write_atomically(self.path, self.buffer.getvalue())
