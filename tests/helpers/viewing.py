"""Calling `render` and `view` with the options of the scene and of the picture side by side."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from carlasc.viewing import RenderResult, Scene, ViewResult, render, view

_SCENE_OPTIONS = {field.name for field in fields(Scene)} - {"source"}


def draw(source: Any, out: Any = None, **options: Any) -> RenderResult:
    """Render a scene."""
    scene, others = _split(options)
    return render(Scene(source, **scene), out, **others)


def write_page(source: Any, out: Any, **options: Any) -> ViewResult:
    """Write a scene as a page."""
    scene, others = _split(options)
    return view(Scene(source, **scene), out, **others)


def _split(options: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    scene = {name: value for name, value in options.items() if name in _SCENE_OPTIONS}
    return scene, {name: value for name, value in options.items() if name not in _SCENE_OPTIONS}
