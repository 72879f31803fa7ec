"""Make sure the machine has a fit Python with its venv module, and the shared libraries that Open3D loads.

Run before the environment exists, so it uses the standard library only. As root on Debian or Ubuntu it installs what is
missing with apt; otherwise it prints one line that says what to run, and exits with 2.
"""

import ctypes
import importlib.util
import os
import shutil
import subprocess
import sys

OLDEST_PYTHON = (3, 11)

# What libOpen3D.so of the Linux wheel links to and no wheel brings along.
PACKAGE_OF_LIBRARY = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libidn2.so.0": "libidn2-0",
    "libstdc++.so.6": "libstdc++6",
    "libudev.so.1": "libudev1",
    "libusb-1.0.so.0": "libusb-1.0-0",
}


def missing_packages() -> list[str]:
    """Return the Debian packages of what cannot be loaded, sorted."""
    packages = {package for library, package in PACKAGE_OF_LIBRARY.items() if not _is_loadable(library)}
    if importlib.util.find_spec("ensurepip") is None:  # Debian ships it apart from python3
        packages.add(f"python3.{sys.version_info.minor}-venv")
    return sorted(packages)


def main() -> int:
    """Install what is missing, or say how. Return the exit code."""
    if sys.version_info < OLDEST_PYTHON:
        version = ".".join(map(str, sys.version_info[:3]))
        sys.stderr.write(f"motionlabel needs Python 3.11 or newer, this is {version}; try: make PYTHON=python3.11\n")
        return 2
    packages = missing_packages() if sys.platform == "linux" else []
    if not packages:
        return 0
    if os.geteuid() == 0 and shutil.which("apt-get"):
        environment = os.environ | {"DEBIAN_FRONTEND": "noninteractive"}
        subprocess.run(["apt-get", "update", "-qq"], env=environment, check=False, stdin=subprocess.DEVNULL)
        install = ["apt-get", "install", "-y", "-qq", "--no-install-recommends", *packages]
        subprocess.run(install, env=environment, check=False, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        importlib.invalidate_caches()
        packages = missing_packages()
    if packages:
        sys.stderr.write(
            f"motionlabel needs system libraries; run: sudo apt-get install {' '.join(packages)}  (then make again)\n"
        )
    return 2 if packages else 0


def _is_loadable(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


if __name__ == "__main__":
    sys.exit(main())
