"""What the C library does with freed memory, in a process of its own: the setting cannot be taken back."""

import ctypes
import subprocess
import sys

import pytest

_FAULTS = """
import ctypes, resource, sys
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.malloc.argtypes, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_size_t], [ctypes.c_void_p]
if sys.argv[1] == "keep":
    from cgsf.threads import keep_freed_memory
    keep_freed_memory()
for _ in range(2):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for size in (8 << 20, 24 << 20):
        memory = libc.malloc(size)
        ctypes.memset(memory, 1, size)
        libc.free(memory)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux") or not hasattr(ctypes.CDLL(None), "mallopt"), reason="needs glibc")
def test_freed_memory_is_kept():
    faults = {}
    for what in ("keep", "leave"):
        run = subprocess.run([sys.executable, "-c", _FAULTS, what], capture_output=True, text=True, check=True)
        faults[what] = int(run.stdout)
    assert faults["keep"] < 100
    assert faults["leave"] > 1000
