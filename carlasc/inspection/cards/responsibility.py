"""The texts of a card about responsible use: how the data were collected and labelled, their
limits, biases and uses.

They are made from the data and from their carlasc.json. They are the fields of Croissant's RAI
vocabulary (https://docs.mlcommons.org/croissant); README.md contains the same texts.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from carlasc.inspection.cards.facts import CardDetails, Facts
from carlasc.inspection.texts import say

RARE = 0.001
"""A class with a smaller share of the points or voxels is called rare."""


def responsibility(facts: Facts, details: CardDetails) -> dict[str, str | list[str] | bool]:
    """Return the RAI fields by their names in Croissant, without the prefix `rai:`."""
    tools = [f"carlasc {version}" for version in facts.versions] or ["carlasc"]
    grids = ", ".join(dict.fromkeys(grid.name for grid, _, _ in facts.grids)) or "none"
    kinds = (
        ("Software Collection", facts.simulated),
        ("Secondary Data analysis", bool(facts.sources)),
    )
    contact = say("contact", contact=details.contact) if details.contact else ""
    return {
        "dataCollection": " ".join(collection(facts)),
        "dataCollectionType": [kind for kind, holds in kinds if holds],
        "dataCollectionMissingData": " ".join(missing(facts)),
        "dataCollectionRawData": say(
            "raw_data", fields=", ".join(facts.fields) or "none kept", grids=grids
        ),
        "dataPreprocessingProtocol": preprocessing(facts),
        "dataImputationProtocol": _imputation(facts),
        "dataManipulationProtocol": " ".join(made(facts)),
        "dataAnnotationProtocol": annotation(facts),
        "dataAnnotationPlatform": tools,
        "dataAnnotationAnalysis": _analysis(facts),
        "annotationsPerItem": _per_item(facts),
        "annotatorDemographics": [
            say("annotators_of_sources" if facts.sources else "no_annotators")
        ],
        "machineAnnotationTools": tools,
        "dataBiases": biases(facts),
        "dataUseCases": uses(facts),
        "dataLimitations": limitations(facts),
        "dataSocialImpact": say("social_impact"),
        "personalSensitiveInformation": [_personal(facts)],
        "dataReleaseMaintenancePlan": say("maintenance", version=details.version, contact=contact),
        "hasSyntheticData": facts.synthetic,
    }


def collection(facts: Facts) -> list[str]:
    """Return how the data were recorded, one sentence each."""
    sentences = [say("simulator")] if facts.simulated else []
    sentences += [say("converted", sources=", ".join(facts.sources))] if facts.sources else []
    return sentences + ([say("sensors", sensors=", ".join(facts.sensors))] if facts.sensors else [])


def missing(facts: Facts) -> list[str]:
    """Return what is missing, one sentence each."""
    share = facts.known_share()
    sentences = [] if share is None else [say("unknown", share=f"{1 - share:.1%}")]
    sentences.append(say("gaps", places=facts.gaps) if facts.gaps else say("no_gaps"))
    partial = [f"{name} ({count})" for name, count in facts.fields.items() if count < facts.frames]
    sentences += [say("partial", frames=facts.frames, fields=", ".join(partial))] if partial else []
    return sentences + ([say("unreadable", files=len(facts.failures))] if facts.failures else [])


def preprocessing(facts: Facts) -> list[str]:
    """Return how the scans were prepared, one sentence each."""
    axes = sorted({sequence.axes for sequence in facts.overview.sequences})
    sentences = [say("axes", axes=" or ".join(say(f"axes_{one}") for one in axes))]
    ranges = {
        (one.metadata.min_range_m, one.metadata.max_range_m) for one in facts.sequences.values()
    }
    for near, far in sorted(ranges - {(None, None)}, key=str):
        limits = [
            f"nearer than {near:g} m" if near else "",
            f"farther than {far:g} m" if far else "",
        ]
        sentences.append(say("ranges", limits=" or ".join(filter(None, limits))))
    estimated = any(
        str(one.metadata.extra.get("poses")).startswith("kiss-icp")
        for one in facts.sequences.values()
    )
    return sentences + ([say("estimated_poses")] if estimated else [])


def annotation(facts: Facts) -> list[str]:
    """Return where labels come from, one sentence each."""
    said = [one.metadata.predicted for one in facts.sequences.values()]
    sentences = [say("predicted_labels", how=how) for how in sorted({how for how in said if how})]
    if all(said):  # no other labels
        return [*sentences, say("votes")] if facts.grids else sentences
    sentences += [say("simulated_labels")] if facts.simulated else []
    if facts.sources:
        boxes = any(one.metadata.extra.get("labels") == "boxes" for one in facts.sequences.values())
        sentences.append(say("labels_of_boxes" if boxes else "labels_of_source"))
    sentences += [say("votes")] if facts.grids else []
    return sentences or [say("no_labels")]


def made(facts: Facts) -> list[str]:
    """Return how each kind of grid was made, one sentence each."""
    sentences = []
    for grid, _, frames in facts.grids:
        size, how = " x ".join(map(str, grid.size)), how_made(grid.made)
        sentences.append(
            say(
                "grid",
                name=grid.name,
                coordinates=grid.coordinates,
                size=size,
                frames=frames,
                made=how,
            )
        )
    return sentences or [say("no_grids")]


def how_made(record: Mapping[str, object] | None) -> str:
    """Return how a grid was made, in words, from the record in its params.json."""
    if record is None:
        return say("made_unknown")
    kind = str(record.get("observe"))
    told = say(f"made_{kind if kind in ('capture', 'scans', 'grid') else 'other'}")
    settings = [
        f"{name} {value}"
        for name, value in record.items()
        if isinstance(value, str | int | float) and name not in ("observe", "format")
    ]
    return f"{told} (settings: {', '.join(settings)})" if settings else told


def biases(facts: Facts) -> list[str]:
    """Return how unbalanced the classes are, one sentence each."""
    sentences = []
    for one in facts.statistics:
        for what, counts in (
            ("points", one.total.points),
            ("known voxels that are occupied", one.total.voxels),
        ):
            occupied = counts.copy()
            occupied[0] = 0  # unlabelled points, free voxels
            total = int(occupied.sum())
            if not total:
                continue
            order = np.argsort(occupied)[::-1][:3]
            top = ", ".join(
                f"{one.classes.names.get(int(k), k)} {occupied[k] / total:.1%}"
                for k in order
                if occupied[k]
            )
            names = [
                name
                for index, name in one.classes.names.items()
                if 0 < occupied[index] < RARE * total
            ]
            rare = say("rare", limit=f"{RARE:.1%}", names=", ".join(names)) if names else ""
            sentences.append(say("unbalanced", what=what, top=top, rare=rare))
    sentences += [say("simulated_biases")] if facts.simulated else []
    sentences += [say("converted_biases")] if facts.sources else []
    return [*sentences, say("near", what="Voxels" if facts.grids else "Surfaces")]


def uses(facts: Facts) -> list[str]:
    """Return what the data are for."""
    told = (
        ("for_completion", bool(facts.grids)),
        ("for_mapping", True),
        ("for_segmentation", "labels" in facts.fields),
        ("for_flow", "flow" in facts.fields),
        ("not_commercial", not all(license_.commercial for license_ in facts.licenses)),
    )
    return [say(use) for use, holds in told if holds]


def limitations(facts: Facts) -> list[str]:
    """Return the known limits, one sentence each."""
    sentences = [say("simulated_limits")] if facts.simulated else []
    sentences += [text for text in missing(facts) if text != say("no_gaps")]
    merged = any(
        grid.made is not None and grid.made.get("observe") == "scans" for grid, _, _ in facts.grids
    )
    sentences += [say("rounded", step=f"{facts.lossy_mm:g}")] if facts.lossy_mm else []
    sentences += [say("traces")] if merged else []
    sentences += (
        [say("class_tables")] if len({one.classes for one in facts.overview.sequences}) > 1 else []
    )
    return sentences + ([say("counted", every=facts.every)] if facts.every > 1 else [])


def _imputation(facts: Facts) -> str:
    inferred = {
        name: report.inferred_share
        for name, report in facts.reports.items()
        if report.inferred_share
    }
    if not inferred:
        return say("not_inferred")
    return say(
        "inferred", shares=", ".join(f"{share:.1%} in {name}" for name, share in inferred.items())
    )


def _analysis(facts: Facts) -> list[str]:
    told = [
        say("convergence", name=name, share=f"{one.convergence.changed_share:.2%}")
        for name, one in facts.reports.items()
        if one.convergence is not None
    ]
    return told or [say("no_convergence")]


def _per_item(facts: Facts) -> str:
    votes = [one.coverage.mean_votes for one in facts.reports.values() if one.coverage.mean_votes]
    return say(
        "per_item", mean=say("mean_votes", mean=f"{sum(votes) / len(votes):.1f}") if votes else ""
    )


def _personal(facts: Facts) -> str:
    if facts.sources and not facts.synthetic:
        return say("personal_pictures" if "bev" in facts.fields else "personal_real")
    return say("personal_converted" if facts.sources else "personal_none")
