"""The light-group integrator on a GPU: the same tests in Mitsuba's CUDA variant, where a GPU is at hand."""

import ctypes
import os
import subprocess
import sys

import pytest

from tests.paths import ROOT

pytestmark = [pytest.mark.mitsuba, pytest.mark.verify]

TESTS = [
    "tests/unit/transport",
    "tests/physics/test_groups.py",
    "tests/physics/test_groups_forms.py",
    "tests/physics/test_smooth_ways.py",
    "tests/physics/test_fog_groups.py",
]


def _gpu() -> bool:
    try:
        return int(ctypes.CDLL("libcuda.so.1").cuInit(0)) == 0
    except OSError:
        return False


@pytest.mark.parametrize("tests", TESTS)
def test_the_integrator_passes_in_cuda_ad_mono(tests: str) -> None:
    if not _gpu():
        pytest.skip("no CUDA GPU: cuda_ad_mono is not tried")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-m", "", tests],
        cwd=ROOT,
        env={**os.environ, "NIR_RENDER_VARIANT": "cuda_ad_mono"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-4000:]
