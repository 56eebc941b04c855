"""What a card says of responsible use: how the data were collected and labelled, their limits, biases and uses.

The texts state what the data and their passports show. They are the fields of Croissant's RAI vocabulary (https://docs.mlcommons.org/croissant),
and the README takes the same texts.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from carlasc.inspection.cards.facts import Details, Facts

RARE = 0.001
"""Share of the points or voxels below which a class is called rare."""


def responsibility(facts: Facts, details: Details) -> dict[str, str | list[str] | bool]:
    """Return the RAI fields by their names in Croissant, without the prefix `rai:`."""
    return {
        "dataCollection": " ".join(collection(facts)),
        "dataCollectionType": _kinds(facts),
        "dataCollectionMissingData": " ".join(missing(facts)),
        "dataCollectionRawData": f"LiDAR scans ({_listed(facts.fields) or 'none kept'}) and voxel grids ({_grids(facts)}).",
        "dataPreprocessingProtocol": preprocessing(facts),
        "dataImputationProtocol": _imputation(facts),
        "dataManipulationProtocol": " ".join(made(facts)),
        "dataAnnotationProtocol": annotation(facts),
        "dataAnnotationPlatform": [f"carlasc {version}" for version in facts.versions] or ["carlasc"],
        "dataAnnotationAnalysis": _analysis(facts),
        "annotationsPerItem": _per_item(facts),
        "annotatorDemographics": [_annotators(facts)],
        "machineAnnotationTools": [f"carlasc {version}" for version in facts.versions] or ["carlasc"],
        "dataBiases": biases(facts),
        "dataUseCases": uses(facts),
        "dataLimitations": limitations(facts),
        "dataSocialImpact": (
            "Scenes help vehicles and robots to perceive free space and road users. Models trained on them must not be relied on for safety "
            "without tests in the place and with the sensor that they are used with."
        ),
        "personalSensitiveInformation": [_personal(facts)],
        "dataReleaseMaintenancePlan": _maintenance(details),
        "hasSyntheticData": facts.synthetic,
    }


def collection(facts: Facts) -> list[str]:
    """Return how the data were recorded, one sentence each."""
    sentences = []
    if facts.simulated:
        sentences.append(
            "Recorded in a simulator (no other source is named in carlasc.json): a vehicle with a LiDAR drives through a simulated town with moving vehicles and pedestrians, and every "
            "return of the LiDAR has the class, the actor and the velocity of the surface that it hit."
        )
    if facts.sources:
        sentences.append(
            f"Converted by carlasc from {', '.join(facts.sources)}; their publishers say how these were recorded, and where."
        )
    if facts.sensors:
        sentences.append(f"Sensors: {', '.join(facts.sensors)}.")
    return sentences


def missing(facts: Facts) -> list[str]:
    """Return what is missing, one sentence each."""
    sentences = []
    share = facts.known_share()
    if share is not None:
        sentences.append(
            f"{1 - share:.1%} of the voxels are unknown (0 votes): no ray reached them. They are not free, and are left out of evaluations."
        )
    sentences.append(
        f"Frame numbers have gaps at {facts.gaps} places."
        if facts.gaps
        else "Frame numbers have no gaps within a sequence."
    )
    partial = {name: count for name, count in facts.fields.items() if count < facts.frames}
    if partial:
        sentences.append(
            f"Not in all {facts.frames} frames: {', '.join(f'{name} ({count})' for name, count in partial.items())}."
        )
    if facts.failures:
        sentences.append(f"{len(facts.failures)} files could not be read.")
    return sentences


def preprocessing(facts: Facts) -> list[str]:
    """Return how the scans were prepared, one sentence each."""
    axes = sorted({sequence.axes for sequence in facts.overview.sequences})
    told = {"left": "left-handed (y to the right, as in CARLA)", "right": "right-handed (y to the left, as in ROS)"}
    sentences = [f"Axes: x forward, z up, {' or '.join(told[one] for one in axes)}. Lengths are in metres."]
    ranges = {(one.metadata.min_range_m, one.metadata.max_range_m) for one in facts.sequences.values()}
    for near, far in sorted(ranges - {(None, None)}, key=str):
        limits = [f"nearer than {near:g} m" if near else "", f"farther than {far:g} m" if far else ""]
        sentences.append(f"Points {' or '.join(filter(None, limits))} go into no grid.")
    if any(one.metadata.extra.get("poses") == "kiss-icp" for one in facts.sequences.values()):
        sentences.append("Poses of some sequences were estimated from the scans (KISS-ICP).")
    return sentences


def annotation(facts: Facts) -> list[str]:
    """Return where labels come from, one sentence each."""
    sentences = []
    if facts.simulated:
        sentences.append("Labels of points are those of the simulator: exact, and made without annotators.")
    if facts.sources:
        boxes = any(one.metadata.extra.get("labels") == "boxes" for one in facts.sequences.values())
        sentences.append(
            "Labels of converted points are "
            + (
                "made from the tracked boxes of the source."
                if boxes
                else "those of the source, in the class table named here."
            )
        )
    if facts.grids:
        sentences.append(
            "The label of a voxel is found by vote: returns vote for a class, and the rays that pass through vote for free space."
        )
    return sentences or ["The data have no labels."]


def made(facts: Facts) -> list[str]:
    """Return how each kind of grid was made, one sentence each."""
    sentences = []
    for grid, _, frames in facts.grids:
        size = " x ".join(map(str, grid.size))
        where = f"The grid {grid.name} ({grid.coordinates}, {size} cells, {frames} frames)"
        sentences.append(f"{where} was {how_made(grid.made)}.")
    return sentences or ["The data have no voxel grids."]


def how_made(record: Mapping[str, object] | None) -> str:
    """Return how a grid was made, in words, from the record in its params.json."""
    if record is None:
        return "published as it is: its params.json has no record of carlasc"
    kinds = {
        "capture": "voted from the scans of all sensors of a raw capture, taken at the same instant",
        "scans": "merged from the scans of other instants along the poses, with moving actors merged in their own motion",
        "grid": "made from a finer grid",
    }
    kind = kinds.get(str(record.get("observe")), "made by carlasc")
    settings = [
        f"{name} {value}"
        for name, value in record.items()
        if isinstance(value, str | int | float) and name not in ("observe", "format")
    ]
    return f"{kind} (settings: {', '.join(settings)})" if settings else kind


def biases(facts: Facts) -> list[str]:
    """Return how the data are unbalanced, one sentence each."""
    sentences = []
    for one in facts.statistics:
        for what, counts in (("points", one.total.points), ("known voxels that are occupied", one.total.voxels)):
            occupied = counts.copy()
            occupied[0] = 0  # unlabelled points, free voxels
            total = int(occupied.sum())
            if not total:
                continue
            order = np.argsort(occupied)[::-1][:3]
            top = ", ".join(
                f"{one.classes.names.get(int(k), k)} {occupied[k] / total:.1%}" for k in order if occupied[k]
            )
            rare = [name for index, name in one.classes.names.items() if 0 < occupied[index] < RARE * total]
            sentences.append(
                f"Classes are unbalanced: of the {what}, the most frequent are {top}"
                + (f"; rare (below {RARE:.1%}): {', '.join(rare)}." if rare else ".")
            )
    if facts.simulated:
        sentences.append(
            "Simulated towns have fewer kinds of buildings, vehicles, plants and people than any real place, and regular traffic."
        )
    if facts.sources:
        sentences.append(
            "Converted sequences have the biases of their source: its places, weather, vehicles and sensors."
        )
    near = "Voxels" if facts.grids else "Surfaces"
    sentences.append(f"{near} near the vehicle and its path are seen more often than those far away or behind others.")
    return sentences


def uses(facts: Facts) -> list[str]:
    """Return what the data are for."""
    found = ["semantic scene completion and occupancy prediction"] if facts.grids else []
    found.append("semantic mapping in dynamic environments")
    if "labels" in facts.fields:
        found.append("semantic segmentation of LiDAR scans")
    if "flow" in facts.fields:
        found.append("scene flow of LiDAR scans")
    if not all(license_.commercial for license_ in facts.licenses):
        found.append("not for commercial use, as the licence of a part of the data says")
    return found


def limitations(facts: Facts) -> list[str]:
    """Return the known limits, one sentence each."""
    sentences = []
    if facts.simulated:
        sentences.append(
            "Simulated LiDAR has no rain, fog, beam divergence or interference; models trained on it alone fail on real scans more often."
        )
    sentences += missing(facts) if facts.gaps else [text for text in missing(facts) if "no gaps" not in text]
    if facts.lossy_mm:
        sentences.append(f"Coordinates of points are rounded to steps of {facts.lossy_mm:g} mm.")
    if any(grid.made is not None and grid.made.get("observe") == "scans" for grid, _, _ in facts.grids):
        sentences.append(
            "Grids merged from scans of other instants may keep traces of actors whose motion was not found."
        )
    if len({sequence.classes for sequence in facts.overview.sequences}) > 1:
        sentences.append(
            "Sequences have different class tables: labels of one must not be read by the table of another."
        )
    if facts.every > 1:
        sentences.append(f"Shares of classes were counted on every {facts.every}th frame.")
    return sentences


def _kinds(facts: Facts) -> list[str]:
    kinds = (("Software Collection", facts.simulated), ("Secondary Data analysis", bool(facts.sources)))
    return [kind for kind, holds in kinds if holds]


def _imputation(facts: Facts) -> str:
    inferred = {name: report.inferred_share for name, report in facts.reports.items() if report.inferred_share}
    if inferred:
        told = ", ".join(f"{share:.1%} in {name}" for name, share in inferred.items())
        return f"Some known voxels were inferred, not seen, and have the flag 1: {told}."
    return "None: voxels that no ray reached are marked as unknown and are not filled in."


def _analysis(facts: Facts) -> list[str]:
    told = [
        f"{name}: {one.convergence.changed_share:.2%} of the voxels change their label if a tenth of the scans is left out."
        for name, one in facts.reports.items()
        if one.convergence is not None
    ]
    return told or [
        "No scans of other frames were merged whose number could matter; `carlasc validate` checks the files."
    ]


def _per_item(facts: Facts) -> str:
    votes = [one.coverage.mean_votes for one in facts.reports.values() if one.coverage.mean_votes]
    mean = f"; a known voxel has {sum(votes) / len(votes):.1f} votes on average" if votes else ""
    return f"One label per point and per voxel{mean}."


def _annotators(facts: Facts) -> str:
    if facts.sources:
        return "The annotators of the sources; their publishers say who they are. carlasc adds no human annotation."
    return "None: nothing was annotated by people."


def _personal(facts: Facts) -> str:
    if facts.sources and not facts.synthetic:
        return (
            "Points of a LiDAR show people and vehicles as shapes of some points, without faces or number plates; poses tell where and when a "
            "vehicle drove. There are no camera pictures of real places."
            if "bev" not in facts.fields
            else "The data hold camera pictures of real places: look at them before you publish them."
        )
    return (
        "None: all people, vehicles and places are simulated."
        if not facts.sources
        else (
            "Simulated sequences show no real person. Points of converted ones show people as shapes of some points, without faces."
        )
    )


def _maintenance(details: Details) -> str:
    contact = f" Report errors to {details.contact}." if details.contact else ""
    return f"Version {details.version}. Corrections are published as a new version, with what changed.{contact}"


def _grids(facts: Facts) -> str:
    return _listed(dict.fromkeys(grid.name for grid, _, _ in facts.grids)) or "none"


def _listed(names: object) -> str:
    return ", ".join(names) if isinstance(names, dict) else ""
