"""Files of every format with a few bytes changed, cut, doubled or swapped, numbers replaced, the encoding or the type another."""

import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from tests.fuzz._corpus import Honest, write_corpus
from tests.fuzz.judge import Attack
from vlgs.data.lens import import_pycolmap

Random = np.random.Generator

_NUMBERS = (
    *(
        b"-1",
        b"0",
        b"1e999",
        b"-1e308",
        b"nan",
        b"inf",
        b"99999999999999999999",
        b"4294967295",
        b"",
    ),
    *(b"1_000", b"0x10", b"1e-400", b"true", b"null", b"[]", b'"x"', b"1" * 5000),
)
_WORDS = (
    b"\xff\xfe",
    b"\0",
    b"\\ud800",
    b"../../x",
    b"/dev/zero",
    b"a" * 5000,
    b"[" * 20_000,
    b'{"a":' * 5000,
)
_INTEGERS = (0, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63, 2**64 - 1)
_FLOATS = (np.nan, np.inf, -np.inf, 1e38, -1e30, 1e300, 0.0)
_DTYPES = (b"<f8", b">f4", b"|O8", b"<c8", b"<U9", b"<i4", b"|V4", b"<f2", b"|b1", b"<M8")


def attacks(folder: Path, seed: int, count: int) -> Iterator[Attack]:
    """Mutated files, the formats in turn."""
    import_pycolmap()  # once, and not in every child
    Image.init()
    corpus = write_corpus(folder / "corpus")
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        honest = corpus[number % len(corpus)]
        other = corpus[int(rng.integers(len(corpus)))]
        yield _attack(folder, honest, other, rng)


def _attack(folder: Path, honest: Honest, other: Honest, rng: Random) -> Attack:
    data = (folder / "corpus" / honest.path).read_bytes()
    names = []
    for _ in range(int(rng.integers(1, 4))):
        name, mutate = _MUTATIONS[int(rng.integers(len(_MUTATIONS)))]
        data = mutate(data, rng)
        names.append(name)
    if rng.random() < 0.02:
        data, names = (folder / "corpus" / other.path).read_bytes(), [f"is {other.path}"]

    def call() -> None:
        unit = folder / "attack" / honest.unit
        shutil.rmtree(folder / "attack", ignore_errors=True)
        shutil.copytree(folder / "corpus" / honest.unit, unit)
        (unit / honest.path.relative_to(honest.unit)).write_bytes(data)
        honest.read(unit)

    said = honest.path.name if honest.names_itself else str(folder / "attack" / honest.unit)
    return Attack(f"{honest.path}: {', '.join(names)}", call, must_say=said)


def _some_place(data: bytes, rng: Random) -> int:
    """A position, half of the time in the header."""
    if not data:
        return 0
    return int(rng.integers(min(len(data), 200) if rng.random() < 0.5 else len(data)))


def _some_length(data: bytes, rng: Random) -> int:
    return int(2 ** rng.uniform(0, np.log2(len(data) + 2)))


def _flip(data: bytes, rng: Random) -> bytes:
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 6))):
        if out:
            out[_some_place(data, rng)] ^= 1 << int(rng.integers(8))
    return bytes(out)


def _cut(data: bytes, rng: Random) -> bytes:
    return data[: _some_place(data, rng)]


def _zero(data: bytes, rng: Random) -> bytes:
    at, length = _some_place(data, rng), _some_length(data, rng)
    return data[:at] + bytes(len(data[at : at + length])) + data[at + length :]


def _double(data: bytes, rng: Random) -> bytes:
    at, length = _some_place(data, rng), _some_length(data, rng)
    return data[: at + length] + data[at:]


def _remove(data: bytes, rng: Random) -> bytes:
    at, length = _some_place(data, rng), _some_length(data, rng)
    return data[:at] + data[at + length :]


def _insert(data: bytes, rng: Random) -> bytes:
    at = _some_place(data, rng)
    return data[:at] + rng.bytes(_some_length(data, rng)) + data[at:]


def _append(data: bytes, rng: Random) -> bytes:
    return data + rng.bytes(_some_length(data, rng))


def _integer(data: bytes, rng: Random) -> bytes:
    at, width = _some_place(data, rng), int(rng.choice([2, 4, 8]))
    value = _INTEGERS[int(rng.integers(len(_INTEGERS)))] % 256**width
    order = "little" if rng.random() < 0.7 else "big"
    return data[:at] + value.to_bytes(width, order) + data[at + width :]


def _float(data: bytes, rng: Random) -> bytes:
    kind = np.dtype(str(rng.choice(["<f4", "<f8"])))
    at = len(data) % 4 + 4 * int(rng.integers(len(data) // 4 + 1))
    with np.errstate(over="ignore"):
        value = np.array(_FLOATS[int(rng.integers(len(_FLOATS)))]).astype(kind).tobytes()
    return data[:at] + value + data[at + len(value) :]


def _token(pattern: bytes, values: tuple[bytes, ...]) -> Callable[[bytes, Random], bytes]:
    def mutate(data: bytes, rng: Random) -> bytes:
        found = [m.span() for m in re.finditer(pattern, data[:100_000])]
        if not found:
            return _flip(data, rng)
        start, end = found[int(rng.integers(len(found)))]
        return data[:start] + values[int(rng.integers(len(values)))] + data[end:]

    return mutate


def _swap_bytes(data: bytes, rng: Random) -> bytes:
    at = _some_place(data, rng) // 4 * 4
    rest = np.frombuffer(data[at : at + (len(data) - at) // 4 * 4], np.uint32).byteswap().tobytes()
    return data[:at] + rest + data[at + len(rest) :]


def _line_ends(data: bytes, rng: Random) -> bytes:
    return data.replace(b"\n", (b"\r\n", b"\r", b"\n\n", b" ")[int(rng.integers(4))])


def _encoding(data: bytes, rng: Random) -> bytes:
    text = data.decode("utf-8", "replace").encode("utf-16")
    return (text, b"\xef\xbb\xbf" + data, data.decode("latin-1").encode())[int(rng.integers(3))]


def _lines(data: bytes, rng: Random) -> bytes:
    lines = data.split(b"\n")
    a, b = (int(i) for i in rng.integers(len(lines), size=2))
    lines[a] = lines[b]
    return b"\n".join(lines)


def _empty(data: bytes, rng: Random) -> bytes:
    return b"" if rng.random() < 0.3 else bytes(len(data))


_MUTATIONS: tuple[tuple[str, Callable[[bytes, Random], bytes]], ...] = (
    ("bits flipped", _flip),
    ("cut short", _cut),
    ("run of zeros", _zero),
    ("block twice", _double),
    ("block gone", _remove),
    ("random bytes within", _insert),
    ("random bytes at the end", _append),
    ("another integer", _integer),
    ("another float", _float),
    ("another number", _token(rb"-?\d+(\.\d+)?(e-?\d+)?", _NUMBERS)),
    ("another word", _token(rb"[A-Za-z_]{2,}", _WORDS)),
    ("another dtype", _token(rb"[<>|][a-zA-Z]\d+", _DTYPES)),
    ("bytes swapped", _swap_bytes),
    ("other line ends", _line_ends),
    ("another encoding", _encoding),
    ("a line for another", _lines),
    ("nothing but zeros, or nothing", _empty),
)
