"""The terms of the loss, one class a file (Eqs. 8, 11 and 12).

An objective says what it needs rendered of the two real views of an iteration, and returns its terms by name. It may render more, own
modules that are trained along, and log numbers. ``conf/loss`` chooses the objectives of a run by name: a new one is one class and one
YAML file.
"""

from vlgs.objectives.blended_view import BlendedView
from vlgs.objectives.code_classes import CodeClasses
from vlgs.objectives.codebook import CodebookLanguage
from vlgs.objectives.language import Language
from vlgs.objectives.lookup import LookupLanguage
from vlgs.objectives.mask_classes import MaskClasses, NeighbourClasses
from vlgs.objectives.objective import Objective, Setup, StepView
from vlgs.objectives.photometric import Photometric
from vlgs.objectives.smooth_codes import SmoothCodes

__all__ = [
    "BlendedView",
    "CodeClasses",
    "CodebookLanguage",
    "Language",
    "LookupLanguage",
    "MaskClasses",
    "NeighbourClasses",
    "Objective",
    "Photometric",
    "Setup",
    "SmoothCodes",
    "StepView",
]
