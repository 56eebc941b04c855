"""What is read: for each kind of input, small valid files and the calls that read them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from faults import foreign, reading, writing


@dataclass(frozen=True)
class Target:
    """One kind of input.

    Attributes:
        name: its name in reports.
        write: writes small valid files into a folder that does not exist.
        read: reads everything of such a folder, each call through `attempt`.
        needs: packages that it needs.
        weight: its part of the cases; less for those that take long.
    """

    name: str
    write: Callable[[Path], object]
    read: Callable[[Path, reading.Attempt], None]
    needs: tuple[str, ...] = ()
    weight: int = 10

    def is_available(self) -> bool:
        """Whether the packages are installed."""
        return all(find_spec(package) is not None for package in self.needs)


TARGETS = (
    Target("folder", writing.write_folder, reading.read_source, weight=20),
    Target("zip", writing.write_zip, reading.read_stored),
    Target("zarr", writing.write_packed(".zarr"), reading.read_stored, ("numcodecs", "pcodec")),
    Target("hdf5", writing.write_packed(".h5"), reading.read_stored, ("h5py", "hdf5plugin"), 4),
    Target("parquet", writing.write_packed(".parquet"), reading.read_stored, ("pyarrow",)),
    Target("capture", writing.write_capture_files, reading.read_captures),
    Target("checks", writing.write_folder, reading.check_source),
    Target("dataset", writing.write_folder, reading.train_on),
    Target("page", writing.write_folder, reading.show),
    Target("pictures", writing.write_few, reading.draw, weight=1),
    Target(
        "packing",
        writing.write_folder,
        reading.pack_again,
        ("numcodecs", "pcodec", "h5py", "hdf5plugin", "pyarrow"),
        2,
    ),
    Target(
        "unpacking", writing.write_packed(".zarr"), reading.unpack_again, ("numcodecs", "pcodec"), 2
    ),
    Target("exporting", writing.write_few, reading.export_again, ("h5py",), 1),
    Target("regrid-captures", writing.write_capture_files, reading.regrid_captures, weight=4),
    Target("reports", writing.write_regridded, reading.read_reports, weight=4),
    Target("tracks", writing.write_regridded, reading.tracks_in),
    Target("regrid", writing.write_regridded, reading.regrid_again, weight=1),
    Target("predictions", writing.write_predictions, reading.score),
    Target("occ3d", writing.write_occ3d, reading.score, weight=4),
    Target("openoccupancy", writing.write_openoccupancy, reading.score, weight=4),
    Target("kitti-predictions", writing.write_kitti_predictions, reading.score, weight=2),
    Target("results", writing.write_results, reading.compare_results),
    Target("weights", writing.write_runs, reading.load_runs, ("torch", "safetensors", "yaml"), 2),
    Target("download", writing.write_archive, reading.unpack_download),
    *(
        Target(name, write, reading.reader_of(name), foreign.PACKAGES.get(name, ()))
        for name, write in foreign.DATA_SETS.items()
    ),
    *(
        Target(
            f"convert-{name}", write, reading.conversion_of(name), foreign.PACKAGES.get(name, ()), 2
        )
        for name, write in foreign.DATA_SETS.items()
    ),
)
"""All kinds of input."""
