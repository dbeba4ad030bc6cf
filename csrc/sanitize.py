"""Fuzz the rasterizer under AddressSanitizer and UndefinedBehaviorSanitizer: `python csrc/sanitize.py --scenes 2000`.

Builds the extension apart, in build/sanitize, and runs `vlgs.bench.fuzz` on it once per instruction set. The first finding ends
the process with the sanitizer's report and a non-zero exit; the last seed printed is the one that it was in.
"""

import argparse
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

SOURCE = Path(__file__).resolve().parent
BUILD = SOURCE.parent / "build" / "sanitize"
RUNTIMES = ("libasan.so", "libstdc++.so.6")  # the second, or an exception is thrown past the first


def build() -> Path:
    """Compile with -DVLGS_SANITIZE=ON; returns the module."""
    nanobind = subprocess.check_output(
        [sys.executable, "-m", "nanobind", "--cmake_dir"], text=True
    ).strip()
    configure = ["cmake", "-S", str(SOURCE), "-B", str(BUILD), "-G", "Ninja"]
    configure += ["-DVLGS_SANITIZE=ON", "-DCMAKE_BUILD_TYPE=Release", f"-Dnanobind_DIR={nanobind}"]
    configure += [f"-DPython_EXECUTABLE={sys.executable}", "-DVLGS_NOSTRIP=NOSTRIP"]
    subprocess.check_call(configure)
    subprocess.check_call(["cmake", "--build", str(BUILD)])
    return next(BUILD.glob("_csrc*.so"))


def fuzz(module: Path, first: int, scenes: int) -> None:
    """In the child process: put the module in the place of the installed one, then fuzz."""
    spec = importlib.util.spec_from_file_location("vlgs._csrc", module)
    assert spec is not None
    assert spec.loader is not None
    sys.modules["vlgs._csrc"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["vlgs._csrc"])
    from vlgs import _csrc
    from vlgs.bench.fuzz import fuzz

    assert _csrc.__file__ == str(module)
    report = fuzz(range(first, first + scenes), verbose=True)
    print(f"{_csrc.isa()} under the sanitizers: {report}")
    sys.exit(bool(report.failures))


def main() -> None:
    """Build, then one child per instruction set."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=2000)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--isa", nargs="+", default=["base", "v3", "v4"])
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        return fuzz(args.child, args.first, args.scenes)
    module = build()
    found = [subprocess.check_output(["gcc", f"-print-file-name={r}"], text=True) for r in RUNTIMES]
    environment = os.environ | {
        "LD_PRELOAD": " ".join(path.strip() for path in found),
        # Python and torch keep memory until the end; a leak of theirs is not looked for.
        "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=0",
        "UBSAN_OPTIONS": "print_stacktrace=1",
    }
    command = [sys.executable, __file__, "--child", str(module)]
    command += ["--first", str(args.first), "--scenes", str(args.scenes)]
    codes = [
        subprocess.run(command, env=environment | {"VLGS_ISA": isa}, check=False).returncode
        for isa in args.isa
    ]
    sys.exit(max(map(abs, codes)))


if __name__ == "__main__":
    main()
