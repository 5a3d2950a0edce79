"""What an import may load: the optimisation-only path never imports torch, the command line loads nothing heavy."""

import subprocess
import sys
import time

import pytest

HEAVY = ("torch", "numba", "matplotlib", "scipy", "cv2", "numpy")


def loaded_by(code):
    """The heavy modules that a fresh interpreter has loaded after `code`."""
    script = f"import sys\n{code}\nprint(*[name for name in {HEAVY} if name in sys.modules], file=sys.__stdout__)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines()[-1].split()) if done.stdout.strip() else set()


def test_import_cgsf_loads_nothing():
    assert loaded_by("import cgsf, cgsf.cli") == set()


@pytest.mark.parametrize("method", ["variational", "opencv", "zero"])
def test_solving_without_learning_never_loads_torch(method):
    code = f"""
import numpy as np, cgsf
images = np.random.default_rng(0).random((4, 64, 96, 3))
result = cgsf.estimate(*images, method={method!r}, calibration=cgsf.Calibration(90, 91, 40, 30, 0.5))
import cgsf.evaluate, cgsf.run, cgsf.metrics, cgsf.visualise, cgsf.datasets
for name in ("kitti2015", "kitti2012", "frames", "folder"):
    __import__(f"cgsf.datasets.{{name}}")
for name in ("run", "evaluate", "report", "demo"):
    __import__(f"cgsf.commands.{{name}}")
"""
    assert "torch" not in loaded_by(code)


def test_help_is_quick():
    start = time.perf_counter()
    subprocess.run([sys.executable, "-m", "cgsf.cli", "--help"], capture_output=True, check=True)
    assert time.perf_counter() - start < 2  # 0.1 s on an idle machine
