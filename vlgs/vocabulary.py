"""Vectors of words for `data.vocabulary`: `python -m vlgs.vocabulary words.txt SCENE/language_features/vocabulary.npz`."""

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from vlgs.data.language import write_vocabulary
from vlgs.data.untrusted.text import read_text
from vlgs.queries.relevancy import CANONICAL_NEGATIVES
from vlgs.queries.text import CLIP_MODEL, ClipText, TextEncoder
from vlgs.types import Vocabulary


def main(arguments: Sequence[str] | None = None) -> None:
    """Read words, encode them, write them; exit status 1 and one message where that cannot be."""
    parser = argparse.ArgumentParser(prog="python -m vlgs.vocabulary", description=__doc__)
    parser.add_argument(
        "words",
        type=Path,
        metavar="WORDS",
        help="text file, a word or phrase a line; # starts a comment",
    )
    parser.add_argument("out", type=Path, metavar="OUT", help="npz to write")
    parser.add_argument(
        "--model",
        default=CLIP_MODEL,
        help="name in the hub's cache or folder with tokenizer (%(default)s)",
    )
    parser.add_argument(
        "--template",
        default="{}",
        help='sentence around a word, e.g. "a photo of a {}" (%(default)s)',
    )
    parser.add_argument(
        "--no-negatives",
        action="store_true",
        help=f"leave out {', '.join(CANONICAL_NEGATIVES)}, which query=lerf_relevancy compares with",
    )
    args = parser.parse_args(arguments)
    try:
        if args.out.suffix.lower() != ".npz" or args.out.is_dir():
            raise ValueError(f"vocabulary: OUT must be a file that ends in .npz, got {args.out}")
        words = read_words(args.words)
        if not args.no_negatives:
            words += [word for word in CANONICAL_NEGATIVES if word not in words]
        encode_words(args.out, words, ClipText(model=args.model), args.template)
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
    print(f"{len(words)} words: {args.out}")


def read_words(path: Path) -> list[str]:
    """The words of a text file, one a line, without blank lines and comments.

    Raises:
        ValueError: If it is no UTF-8 text, has no words or one of them twice.
        OSError: If it cannot be read.
    """
    lines = read_text(path).splitlines()
    words = [word for line in lines if (word := line.partition("#")[0].strip())]
    twice = sorted(word for word, count in Counter(words).items() if count > 1)
    if twice:
        raise ValueError(f"{path}: words must be unique, got {', '.join(twice[:5])} more than once")
    if not words:
        raise ValueError(f"{path}: words must be at least one, got none")
    return words


def encode_words(
    path: Path, words: Sequence[str], encoder: TextEncoder, template: str = "{}"
) -> None:
    """Write an npz of `names` and `embeddings`, as `data.vocabulary` reads it.

    Args:
        path: To be replaced, whole or not at all.
        words: What can be asked for later, spelled like this.
        encoder: What gives each of them a vector.
        template: Sentence that each is put into at ``{}`` before it is encoded.

    Raises:
        ValueError: If the template has no place for the word, or a word cannot be encoded.
        OSError: If weights are missing or the file cannot be written.
    """
    if template.count("{}") != 1:
        raise ValueError(f"vocabulary: template must contain {{}} once, got {template!r}")
    vectors = encoder.encode([template.replace("{}", word) for word in words])
    path.parent.mkdir(parents=True, exist_ok=True)
    write_vocabulary(path, Vocabulary(tuple(words), vectors))


if __name__ == "__main__":
    main()
