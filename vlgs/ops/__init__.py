"""The differentiable operations, one a file, and the only code that imports the compiled kernels (`vlgs.ops._csrc`).

A file holds the typed function that the package calls, the autograd function over the CPU's kernel, and ``KERNELS``, a table from
the type of a device to what computes the operation there. Another device is one new file, ``<operation>_<device>.py`` beside the
operation's own (`vlgs.ops.device`). The definition that a kernel is checked against shares no code with it: `rasterize_reference`
here, or a function in the tests that the docstring names.
"""

from importlib.util import find_spec

# Missing in a checkout that nobody installed, or one installed before the kernels moved here.
if find_spec("vlgs.ops._csrc") is None:
    raise ImportError(
        "vlgs: compiled kernels must be there, got none in vlgs/ops; python -m pip install -e . makes them"
    )
