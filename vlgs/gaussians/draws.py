"""Random numbers that a resumed run draws again."""

import hashlib

import torch


def seeded_generator(purpose: str, seed: int, step: int) -> torch.Generator:
    """A generator that depends on (purpose, seed, step) alone, so that a resumed run draws what it would have drawn.

    The three are hashed because torch's generator for the CPU takes only the low 32 bits of its seed.
    """
    digest = hashlib.blake2b(f"{purpose}:{seed}:{step}".encode(), digest_size=4).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest, "little"))
