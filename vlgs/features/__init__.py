"""Language maps from photographs: masks of a segmenter, or tiles, and a vector each from an image encoder, in LangSplat's files.

`python -m vlgs.features data=colmap data.root=SCENE`; the parts are Protocols, chosen by ``conf/features``.
"""

from vlgs.features.extractor import Encoder, Extractor, MaskExtractor, MaskFeatures, Segmenter
from vlgs.features.masks import Mask

__all__ = ["Encoder", "Extractor", "Mask", "MaskExtractor", "MaskFeatures", "Segmenter"]
