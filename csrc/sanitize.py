"""Fuzz the kernels under AddressSanitizer and UndefinedBehaviorSanitizer: `python csrc/sanitize.py --isa v4 --scenes 10000`.

Builds the extension apart, in build/sanitize, with the instruction sets asked for, and runs `tests.fuzz_kernel` on each: seeds from 0 on,
in parts, each recorded in results/bench/fuzz.csv when it ends and not run again on the same code. The first finding ends a part
with the sanitizer's report; the seed that it was in is named. `--first SEED --scenes 1` runs one scene again and records nothing.
"""

import argparse
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

SOURCE = Path(__file__).resolve().parent
BUILD = SOURCE.parent / "build" / "sanitize"
RECORD = SOURCE.parent / "results" / "bench" / "fuzz.csv"
SANITIZERS = "address, undefined"
RUNTIMES = ("libasan.so", "libstdc++.so.6")  # the second, or an exception is thrown past the first


def build(isas: list[str]) -> Path:
    """Compile with -DVLGS_SANITIZE=ON; returns the module."""
    nanobind = subprocess.check_output(
        [sys.executable, "-m", "nanobind", "--cmake_dir"], text=True
    ).strip()
    configure = ["cmake", "-S", str(SOURCE), "-B", str(BUILD), "-G", "Ninja"]
    configure += ["-DVLGS_SANITIZE=ON", "-DCMAKE_BUILD_TYPE=Release", f"-Dnanobind_DIR={nanobind}"]
    configure += [f"-DPython_EXECUTABLE={sys.executable}", "-DVLGS_NOSTRIP=NOSTRIP"]
    subprocess.check_call([*configure, f"-DVLGS_ISAS={';'.join(isas)}"])
    subprocess.check_call(["cmake", "--build", str(BUILD)])
    return next(BUILD.glob("_csrc*.so"))


def fuzz_here(module: Path, isa: str, seeds: range) -> None:
    """In the child process: put the module in the place of the installed one, fuzz, print the report as the last line."""
    spec = importlib.util.spec_from_file_location("vlgs.ops._csrc", module)
    assert spec is not None
    assert spec.loader is not None
    sys.modules["vlgs.ops._csrc"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["vlgs.ops._csrc"])
    from tests.fuzz_kernel import fuzz
    from vlgs.ops import _csrc

    assert _csrc.__file__ == str(module)
    if _csrc.isa() != isa:
        sys.exit(f"sanitize: the CPU must have {isa}, got {_csrc.isa()} at best")
    print(json.dumps(vars(fuzz(seeds, verbose=True))))


def fuzz_in_child(module: Path, isa: str, seeds: range):
    """A report of some seeds; a process that ended before its report failed in the seed it had announced last."""
    from tests.fuzz_kernel import FuzzReport

    found = [subprocess.check_output(["gcc", f"-print-file-name={r}"], text=True) for r in RUNTIMES]
    environment = os.environ | {
        "VLGS_ISA": isa,
        "LD_PRELOAD": " ".join(path.strip() for path in found),
        # Python and torch keep memory until the end; a leak of theirs is not looked for.
        "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=0",
        "UBSAN_OPTIONS": "print_stacktrace=1",
    }
    command = [sys.executable, __file__, "--child", str(module), "--isa", isa]
    command += ["--first", str(seeds.start), "--scenes", str(len(seeds))]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        last = ""
        for line in child.stdout:
            last = line.strip()
    if last.startswith("{"):
        report = json.loads(last)
        failures = {int(seed): what for seed, what in report.pop("failures").items()}
        return FuzzReport(**report, failures=failures)
    if not last.startswith("seed "):
        sys.exit(f"sanitize: the process of {isa} must run scenes, got status {child.returncode}")
    return FuzzReport(failures={int(last.split()[1]): f"ended with status {child.returncode}"})


def main() -> None:
    """Build, then the fuzz on one instruction set after the other."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=2000, help="in all, with those recorded")
    parser.add_argument("--first", type=int, help="first seed; default: 0, and record")
    parser.add_argument("--isa", nargs="+", default=["v4", "v3", "base"])
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    sys.path.append(str(SOURCE.parent))  # of tests, which are not installed
    seeds = range(args.first or 0, (args.first or 0) + args.scenes)
    if args.child:
        return fuzz_here(args.child, args.isa[0], seeds)
    from tests.fuzz_kernel.record import CLEAN, run_fuzz

    module, failed = build(args.isa), False
    for isa in args.isa:
        if args.first is None:
            row = run_fuzz(
                isa, SANITIZERS, args.scenes, lambda s, i=isa: fuzz_in_child(module, i, s), RECORD
            )
            failed |= row.outcome != CLEAN
        else:
            report = fuzz_in_child(module, isa, seeds)
            print(f"{isa}: {report}")
            failed |= bool(report.failures)
    sys.exit(failed)


if __name__ == "__main__":
    main()
