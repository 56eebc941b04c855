"""Whether the files of a data set changed since its recordings were converted.

A frame may depend on any file of its recording, because tracks and estimated poses reach over all
scans, and a converter reads files in its own way. So after a change, all frames of the recordings
that may have been read from the changed files are made again, and those that differ are written.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from carlasc.converting.plans import KISS_ICP, RecordingPlan
from carlasc.converting.protocol import Recording
from carlasc.converting.stages import Conversion
from carlasc.core.choices import CompareInputs
from carlasc.storage.inputs import MadeFrom, changed_names, combined, folder_states, made_again

_NAME = "conversion"
# the states of frames; others were finished without a frame that is a gap
_DONE, _FAILED, _GAP = "done", "failed", "gap"


@dataclass
class ConversionRecord:
    """The record of the files that a recording was converted from.

    Attributes:
        plan: the recording and its output.
        before: the record of an earlier run.
        states: the states of the folders now; None if they are not compared.
        notes: what was made again, and why, one line each.
    """

    plan: RecordingPlan
    before: MadeFrom
    states: Mapping[str, str] | None
    notes: list[str] = field(default_factory=list)

    def finish(self, conversion: Conversion) -> None:
        """Write the record, after the frames were written."""
        if self.plan.again:
            conversion.remove_others(map(int, self.before.frames))
            if conversion.changed:
                why = changed_names(self.before.own, self.states or {})
                where = self.plan.writer.location
                self.notes.append(f"{where}: {made_again(conversion.changed, why)}")
        if self.states is not None:
            has_gaps = conversion.allow_gaps or self.plan.pose_source == KISS_ICP
            self.write(dict.fromkeys(conversion.failed, _GAP if has_gaps else _FAILED))

    def write(self, failed: Mapping[int, str] = MappingProxyType({})) -> None:
        """Write the record of the states of now."""
        own = dict(self.states or {})
        numbers = [handle.number for handle in self.plan.recording.frames]
        frames = {str(number): failed.get(number, _DONE) for number in numbers}
        MadeFrom(combined(sorted(own.items())), own, frames).write(self.plan.writer, _NAME)


@dataclass(frozen=True)
class SourceFiles:
    """The states of the files of a data set.

    Attributes:
        root: the data set.
        states: the state of each folder by the location of the recording that it belongs to; by
            None if it may belong to all.
        compare: how files are compared.
    """

    root: Path
    states: Mapping[str | None, Mapping[str, str]]
    compare: CompareInputs

    @classmethod
    def of(
        cls,
        root: Path,
        recordings: Iterable[Recording],
        options: Mapping[str, Any] | None,
        compare: CompareInputs,
    ) -> SourceFiles:
        """Read the states of all files of a data set, and of those that options name."""
        places = {"": root}
        for name, value in (options or {}).items():
            if isinstance(value, str | os.PathLike) and str(value) and Path(value).exists():
                places[f"--{name}"] = Path(value)
        owners = {
            Path(one.location).relative_to(root).as_posix(): one.location
            for one in recordings
            if Path(one.location).is_relative_to(root) and Path(one.location) != root
        }
        states: dict[str | None, dict[str, str]] = {None: {}}
        for name, state in ({} if compare == "never" else folder_states(places)).items():
            above = [str(place) for place in (Path(name), *Path(name).parents)]
            owner = next((owners[place] for place in above if place in owners), None)
            states.setdefault(owner, {})[name] = state
        return cls(root, states, compare)

    def begin(self, plan: RecordingPlan) -> ConversionRecord:
        """Compare the files of a recording with those that its output was made from; if they
        differ, all of its frames are made again.
        """
        before = MadeFrom.read(plan.writer, _NAME)
        if self.compare == "never":
            return ConversionRecord(plan, before, None)
        states = {**self.states[None], **self.states.get(plan.recording.location, {})}
        exists = len(plan.missing) < len(plan.recording.frames)
        record = ConversionRecord(plan, before, states)
        is_other = before.own != states or _GAP in before.frames.values()
        if exists and (is_other or self.compare == "content"):
            plan.make_again()
        else:
            record.write()
        return record
