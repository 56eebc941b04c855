"""Peak memory of a process that a test starts."""

PRINT_PEAK = """
import resource as _resource
from pathlib import Path as _Path
# getrusage counts what the parent held when it started this process: beside a large parent, every
# process seems large, and none seems to grow
_status = _Path("/proc/self/status")
if _status.exists():
    print(int(_status.read_text().partition("VmHWM:")[2].split()[0]))
else:
    print(_resource.getrusage(_resource.RUSAGE_SELF).ru_maxrss)
"""
"""Code that prints the largest memory which its process has held, in kilobytes (bytes on macOS)."""
