"""Open3D where a slim system lacks libusb: the library that libusb-package brings is loaded first."""

from types import ModuleType


def open3d() -> ModuleType:
    """The open3d module. Raises RuntimeError with the remedy if it cannot be imported."""
    import ctypes

    try:
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError):
        pass  # systems other than slim Linux have a libusb, or open3d does not ask for one
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise RuntimeError(f"cannot import open3d: {error}; run `make setup`, or install libusb-1.0") from error
    return open3d
