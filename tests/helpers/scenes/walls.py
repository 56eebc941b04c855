"""Worlds of walls, drives past them, and the loops that are found there."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from carlasc.core.geometry import invert, multiply, rotation_z, small_motions, translation
from carlasc.motion.loops import Submaps, close_loops
from carlasc.motion.refinement import ThinnedScan


def wall(one, other, height, per_m2=8.0):
    """Return points of an upright wall between two places, (x, y) each."""
    one, other = np.array(one, float), np.array(other, float)
    count = int(np.linalg.norm(other - one) * height * per_m2)
    rng = np.random.default_rng(0)
    at, up = rng.random((count, 1)), rng.random(count) * height
    return np.column_stack([one + at * (other - one), up])


def level(low, high, z, per_m2=2.0):
    """Return points of a level rectangle."""
    count = int(np.prod(np.subtract(high, low)) * per_m2)
    rng = np.random.default_rng(1)
    return np.column_stack([rng.uniform(low, high, (count, 2)), np.full(count, z)])


def drive(corners):
    """Return world_T_sensor every two metres along a line of corners, 1.7 m above the ground."""
    corners, poses = np.array(corners, float), []
    for one, other in pairwise(corners):
        way = other - one
        length, yaw = np.linalg.norm(way), np.arctan2(way[1], way[0])
        for at in np.arange(0, length, 2.0):
            pose = np.eye(4)
            pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
            pose[:3, 3] = *(one + at / length * way), 1.7
            poses.append(pose)
    return np.array(poses)


def scan(world, pose, rng):
    """Return a third of the points within 35 m, with errors of 2 cm, in the frame of the sensor."""
    off = world[rng.integers(3) :: 3] - pose[:3, 3]
    near = off[np.square(off[:, :2]).sum(axis=1) < 35**2]
    return ((near + rng.normal(0, 0.02, near.shape)) @ pose[:3, :3]).astype(np.float32)


def close(scans, given):
    submaps = Submaps()
    for row, (points, pose) in enumerate(zip(scans, given, strict=True)):
        thinned = ThinnedScan.of(points, pose)
        submaps.add(row, thinned.used, thinned.measured, pose)
    submaps.finish()
    return close_loops(submaps.done, given)


def record(world, true, seed=0):
    rng = np.random.default_rng(seed)
    return [scan(world, pose, rng) for pose in true]


def off_at_end(found, true, start):
    """Return the error of the motion from a pose at the start to the last one, m and degrees."""
    motions = [multiply(invert(poses[start]), poses[-1]) for poses in (true, found)]
    off = small_motions(multiply(invert(motions[0]), motions[1])[None])[0]
    return np.linalg.norm(off[:3]), np.degrees(np.linalg.norm(off[3:]))


def drifted(true):
    """Return poses whose motions are wrong by 3 mm and 0.002 degrees per metre."""
    error, found = translation((0.006, 0.002, 0.003)) @ rotation_z(np.radians(0.004)), [true[0]]
    for one, other in pairwise(true):
        found.append(multiply(found[-1], invert(one), other, error))
    return np.array(found)
