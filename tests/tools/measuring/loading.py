"""Samples of stacked scans: carlasc beside other loaders, and from every store."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from benchmarks import test_bench_dataset as plain_files
from benchmarks import test_bench_storage as stores
from helpers.references.plain_loader import LOADERS

import carlasc
from carlasc import Dataset
from measuring.figures import Figure, ratio, within
from measuring.sizes import Size

_ORDERS = {"random": "random", "in order": "in_order"}


def measure_loading(size: Size, folder: Path) -> Iterator[tuple[str, Figure]]:
    """Yield the time of a sample, by field, history and order."""
    street = plain_files.write_street(folder / "Train" / "Town01_Light" / "cartesian", full=True)
    yield (
        "loading.points",
        Figure(float(_mean_size(street / "velodyne") / 16), "", "points per scan"),
    )
    rays = Dataset(street, history=5, fields=("visibility",))
    rays[4]
    calls = {"visibility": (lambda frame: rays[int(frame)], np.arange(4, 12))}
    found_ms = float(stores._milliseconds(calls, min(size.repeats, 3))["visibility"])
    yield (
        "loading.visibility.5",
        Figure(found_ms, "ms", "the field visibility, T = 5: processor time per sample"),
    )
    yield (
        "loading.visibility.scan",
        Figure(found_ms / 5, "ms", "the field visibility, T = 5: processor time per scan"),
    )
    ratios: dict[str, list[Figure]] = {"occupancy": [], "density": []}
    for what, found in ratios.items():
        for history in (1, 5, 16):
            rivals = {
                name: make(street, history, density=what == "density")
                for name, make in LOADERS.items()
            }
            for order, name in _ORDERS.items():
                places = plain_files.places(history, order == "in order")
                dataset = Dataset(street, history=history, fields=(what, "labels", "known"))
                key, text = (
                    f"loading.{what}.{history}.{name}",
                    f"{what}, T = {history}, {order}: processor time per sample",
                )
                dataset[int(places[0])], rivals["numba"][int(places[0])]  # compiles
                quick = {
                    "carlasc": (lambda frame, d=dataset: d[int(frame)], places),
                    "reading": (
                        lambda frame, t=history: plain_files._read(street, int(frame), t),
                        places,
                    ),
                }
                quick["numba"] = (lambda frame, r=rivals["numba"]: r[int(frame)], places)
                slow = {
                    name: (lambda frame, r=rivals[name]: r[int(frame)], places[:6])
                    for name in ("plain", "float32")
                }
                times = stores._milliseconds(slow, min(size.repeats, 3)) | stores._milliseconds(
                    quick, size.repeats
                )
                figures = {
                    way: Figure(float(found_ms), "ms", f"{text}, {way}")
                    for way, found_ms in times.items()
                }
                best = min((figures[name] for name in LOADERS), key=lambda one: one.value)
                figures["ratio"] = ratio(best, figures["carlasc"], f"{text}, best other / carlasc")
                found.append(figures["ratio"])
                yield from ((f"{key}.{way}", figure) for way, figure in figures.items())
        yield (
            f"loading.{what}.ratio",
            within(found, f"{what}: best other / carlasc, all histories and orders"),
        )


def measure_stores(size: Size, folder: Path) -> Iterator[tuple[str, Figure]]:
    """Yield the time of a sample of 16 scans, and of one field of a frame, from every store."""
    paths = stores.write_stores(folder, full=True)
    repeats = min(size.repeats, 5)
    for order, place in _ORDERS.items():
        datasets = {name: Dataset(path, history=stores.HISTORY) for name, path in paths.items()}
        calls = {
            name: (dataset.__getitem__, stores.places(order)) for name, dataset in datasets.items()
        }
        times = stores._milliseconds(calls, repeats)
        yield from _of_stores(f"stores.sample.{place}", times, f"a sample of 16 scans, {order}")
    for field in ("points", "evaluation/labels", "evaluation/counts"):
        sequences = {
            name: carlasc.open(path).sequences()[stores.PATH] for name, path in paths.items()
        }
        reads = {
            name: (lambda frame, s=sequence, f=field: s.read(f, frame).sum(), range(stores.FRAMES))
            for name, sequence in sequences.items()
        }
        times = stores._milliseconds(reads, repeats)
        yield from _of_stores(
            f"stores.{field.rpartition('/')[2]}", times, f"{field} of a frame, read and added up"
        )


def _of_stores(key: str, times: dict[str, float], what: str) -> Iterator[tuple[str, Figure]]:
    figures = {
        name: Figure(float(found_ms), "ms", f"{what}, from {name}: processor time of all threads")
        for name, found_ms in times.items()
    }
    for name, figure in figures.items():
        yield f"{key}.{_key(name)}", figure
        if name != "files":
            yield (
                f"{key}.{_key(name)}.ratio",
                ratio(figure, figures["files"], f"{what}: {name} / files"),
            )


def _key(store: str) -> str:
    return store.replace(" --", "_")


def _mean_size(folder: Path) -> float:
    return float(np.mean([path.stat().st_size for path in folder.iterdir()]))
