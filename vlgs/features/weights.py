"""Weights of pretrained models: where they are on this machine, a digest of their content, and an error that says what to do if they are missing."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from vlgs.data.diagnostics import SceneError
from vlgs.data.untrusted.text import read_json
from vlgs.extras import require_extra
from vlgs.queries.text import load_whole

CONFIG, PREPROCESSING = "config.json", "preprocessor_config.json"
WEIGHTS, SHARDS = "model.safetensors", "model.safetensors.index.json"

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}


@dataclass(frozen=True, kw_only=True)
class Pretrained:
    """A pretrained model and how it is to run.

    Raises:
        ValueError: If the dtype is unknown.
    """

    name: str
    """Repository on the model hub, ``owner/name``, or a folder."""
    weights: str | None = None
    """Folder that has the repository as a folder of its last name; None for the hub's cache on this machine."""
    dtype: str = "float32"
    """float32, bfloat16 or float16."""
    device: str = "cpu"

    def __post_init__(self) -> None:
        if self.dtype not in DTYPES:
            raise ValueError(
                f"features: dtype must be one of {', '.join(DTYPES)}, got {self.dtype}"
            )

    @property
    def torch_dtype(self) -> torch.dtype:
        """What `dtype` names."""
        return DTYPES[self.dtype]

    def folder(self) -> Path:
        """Where config.json, preprocessor_config.json and the weights are.

        Raises:
            FileNotFoundError: If one of them is missing; it says what to download and where to put it.
        """
        folder = self._candidate()
        missing = [name for name in (CONFIG, PREPROCESSING) if not (folder / name).is_file()]
        if not any((folder / name).is_file() for name in (WEIGHTS, SHARDS)):
            missing.append(WEIGHTS)
        if not missing:
            return folder
        last = self.name.rpartition("/")[2]
        raise FileNotFoundError(
            f"features: {folder} must hold {CONFIG}, {PREPROCESSING} and {WEIGHTS} of {self.name}, got no "
            f"{', no '.join(missing)}; where there is a network run\n"
            f'  hf download {self.name} --include "*.json" "*.safetensors" --local-dir WEIGHTS/{last}\n'
            "and set features.weights=WEIGHTS, a folder that holds all models beside each other"
        )

    def digest(self) -> str:
        """Hash of configuration and weights.

        Raises:
            FileNotFoundError: As `folder`.
        """
        folder = self.folder()
        hasher = hashlib.blake2b(digest_size=16)
        for path in sorted(
            [folder / CONFIG, folder / PREPROCESSING, *folder.glob("model*.safetensors")]
        ):
            with path.open("rb") as stream:
                hasher.update(hashlib.file_digest(stream, "blake2b").digest())
        return hasher.hexdigest()

    def preprocessing(self) -> dict[str, Any]:
        """What preprocessor_config.json says.

        Raises:
            FileNotFoundError: As `folder`.
            ValueError: If it has no mean and standard deviation of three channels.
        """
        path = self.folder() / PREPROCESSING
        try:
            content = read_json(path, "image_mean and image_std of three channels")
            if len(content["image_mean"]) != 3 or len(content["image_std"]) != 3:
                raise ValueError("not three channels")
        except SceneError:
            raise
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"{path}: content must be image_mean and image_std of three channels, got {type(error).__name__}: {error}"
            ) from error
        return content

    def load(self, auto: Any) -> Any:
        """The model, ready for inference in float32 or `dtype`, on `device`.

        Args:
            auto: A transformers class with ``from_pretrained``.

        Raises:
            FileNotFoundError: As `folder`.
            ValueError: If the files do not hold such a model, or not all of it.
        """
        from transformers.utils import logging

        folder = self.folder()
        logging.disable_progress_bar()  # ours is on the screen
        model = load_whole(auto, folder, f"a whole model of {self.name}", use_safetensors=True)
        return model.eval().requires_grad_(False).to(self.device)

    def _candidate(self) -> Path:
        """The folder that the files should be in."""
        if self.weights is not None:
            return Path(self.weights) / self.name.rpartition("/")[2]
        if Path(self.name).is_dir():
            return Path(self.name)
        require_extra("huggingface_hub", "features")
        from huggingface_hub import constants, try_to_load_from_cache

        cached = try_to_load_from_cache(self.name, CONFIG) if self.name.count("/") == 1 else None
        if isinstance(cached, str):
            return Path(cached).parent
        return Path(constants.HF_HUB_CACHE) / f"models--{self.name.replace('/', '--')}"
