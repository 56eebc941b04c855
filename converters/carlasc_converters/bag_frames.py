"""The frames of a bag: the messages of its LiDARs by time, and how their points are read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np
from numpy.typing import NDArray

from carlasc.converting.protocol import Cloud, FrameHandle
from carlasc.core.geometry import transform_points
from carlasc.errors import FormatError
from carlasc_converters.bag_messages import CloudMessage, read_cloud, read_stamp
from carlasc_converters.bag_topics import MessagePlace, Topic
from carlasc_converters.point_fields import TimeUnit, named_fields, point_seconds

_PACKETS_HZ = 150  # messages that are more frequent are packets, because no LiDAR turns so fast
_OWN_CLOCK_S = (
    1.0  # times of points that differ more from the time of the message are from another clock
)
_PROBES = 5  # number of messages from which the unit of the times of points is found


class LidarTopic:
    """A topic of points: its messages by their time.

    Attributes:
        name: of the topic.
    """

    def __init__(self, topic: Topic, time_unit: TimeUnit) -> None:
        self.name, self._topic, self._time_unit = topic.channel.topic, topic, time_unit
        self.notes: list[str] = []
        gaps = np.diff(np.sort(topic.times)) / 1e9
        if len(gaps) >= _PROBES and (period := float(np.median(gaps))) * _PACKETS_HZ < 1:
            raise FormatError(
                f"{topic.parts[0][0]}: {self.name}",
                expected="a message for each turn of the LiDAR",
                found=f"{len(topic)} messages, {1 / max(period, 1e-9):.0f} per second, of a packet "
                f"each",
                advice="set the driver to publish full turns, and replay its packets",
            )

    @cached_property
    def _read(self) -> tuple[NDArray[np.int64], list[MessagePlace]]:
        """The time and position of each message, by time.

        An unreadable message follows the one before it; reading its frame reports the error.
        """
        found, places = list[int | None](), list(self._topic.places())
        for place in places:
            try:
                found.append(read_stamp(place.read(), place.channel, str(place)))
            except FormatError:
                found.append(None)
        lead = next((row for row, stamp in enumerate(found) if stamp is not None), 0)
        stamps = [(found[lead] or 0) - lead - 1]
        for stamp in found:
            stamps.append(stamps[-1] + 1 if stamp is None else stamp)
        del stamps[0]
        # the fields were not filled in
        known = np.array(stamps, np.int64) if any(found) else self._topic.times
        times, first = np.unique(known, return_index=True)
        if len(times) < len(stamps):
            self.notes.append(
                f"{self.name}: {len(stamps) - len(times)} messages have the time of another one, "
                f"and are left out"
            )
        return times, [places[row] for row in first]

    @property
    def stamps(self) -> NDArray[np.int64]:
        """(F,) increasing times in nanoseconds."""
        return self._read[0]

    @property
    def places(self) -> list[MessagePlace]:
        """The position of each message."""
        return self._read[1]

    @cached_property
    def frame(self) -> str:
        """The frame of the sensor."""
        return next(self._readable()).frame

    def _readable(self) -> Iterator[CloudMessage]:
        """Yield the first messages that can be read.

        Raises:
            FormatError: no message can be read.
        """
        problem, count = None, 0
        for place in self.places:
            try:
                yield read_cloud(place.read(), place.channel, str(place))
                count += 1
            except FormatError as error:
                problem = problem or error
            if count == _PROBES:
                return
        if problem is not None and not count:
            raise problem

    @cached_property
    def unit(self) -> TimeUnit:
        """The unit of the times of points, from the first messages; "auto" if points have no times."""
        if self._time_unit != "auto":
            return self._time_unit
        problem: FormatError | None = None
        for message in self._readable():
            fields = named_fields(message.columns, self.name)
            if "time" not in fields or not np.any(fields["time"]):
                continue
            try:
                unit = message.time_unit or point_seconds(fields["time"], "auto", self.name)[2]
            except FormatError as error:
                problem = error
            else:
                self.notes.append(f"{self.name}: the times of points are in {unit}")
                return cast(TimeUnit, unit)
        if problem is not None:
            raise problem
        return "auto"

    def nearest(self, stamps: NDArray[np.int64]) -> list[MessagePlace | None]:
        """Return the message nearest to each time; None if it is farther away than the interval of
        messages.
        """
        own = self.stamps
        reach = float(np.median(np.diff(own))) if len(own) > 1 else float("inf")
        rows = np.searchsorted((own[:-1] + own[1:]) // 2, stamps)
        near = np.abs(own[rows] - stamps) <= reach
        if not near.all():
            self.notes.append(
                f"{self.name}: has no message near {np.count_nonzero(~near)} of {len(stamps)} "
                f"frames"
            )
        return [
            self.places[row] if there else None
            for row, there in zip(rows.tolist(), near.tolist(), strict=True)
        ]


@dataclass(frozen=True)
class CloudPlace:
    """The points of a LiDAR for a frame.

    Attributes:
        sensor: index of the LiDAR.
        place: its message.
        unit: unit of the times of points.
    """

    sensor: int
    place: MessagePlace
    unit: TimeUnit


@dataclass(frozen=True)
class BagFrame(FrameHandle):
    """A message of the first LiDAR.

    Attributes:
        stamp_ns: its time.
        clouds: the messages with the points of each LiDAR.
    """

    number: int
    location: str
    stamp_ns: int
    clouds: tuple[CloudPlace, ...]

    def read(self) -> Sequence[Cloud]:
        """Read the points of each LiDAR.

        Points that are NaN or at the origin are no returns, and left out.
        """
        return [self._read(cloud) for cloud in self.clouds]

    def _read(self, cloud: CloudPlace) -> Cloud:
        where = str(cloud.place)
        message = read_cloud(cloud.place.read(), cloud.place.channel, where)
        fields = named_fields(message.columns, where)
        points = fields["points"]
        seen = np.isfinite(points[:, :3]).all(axis=1) & points[:, :3].any(axis=1)
        if not seen.any():
            raise FormatError(self.location, expected="points", found="none")
        points = points[seen]
        if message.pose is not None:
            points[:, :3] = transform_points(message.pose, points[:, :3])
        points[:, 3] = np.nan_to_num(points[:, 3])
        seconds = self._seconds_of(message, fields.get("time"), cloud.unit, where)
        return Cloud(
            points, seconds=None if seconds is None else seconds[seen], sensor=cloud.sensor
        )

    def _seconds_of(
        self, message: CloudMessage, times: NDArray[np.generic] | None, unit: TimeUnit, where: str
    ) -> NDArray[np.float64] | None:
        """Return the time of each point after the time of the frame; None if it is not known."""
        late = (message.stamp_ns - self.stamp_ns) * 1e-9
        if times is None:
            return np.full(len(next(iter(message.columns.values()))), late) if late else None
        seconds, start_ns, _ = point_seconds(times, unit, where)
        if start_ns is not None:
            after = (start_ns - message.stamp_ns) * 1e-9
            seconds = seconds + (after if abs(after) < _OWN_CLOCK_S else 0.0)
        return seconds + late
