"""What may stand for a scenario: a path, JSON text, or a dict."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import Any, Union

from . import _native
from ._errors import ScenarioError

Scene = Union[str, bytes, "os.PathLike[str]", Mapping[str, Any]]
"""A path of a JSON file, JSON text (it begins with a brace), or the scenario as a dict."""

LARGEST_BYTES = 64 << 20


def plain(value: Any) -> Any:
    """A number or an array of NumPy as JSON can hold it."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is no value of JSON")


def is_text(scene: Scene) -> bool:
    return isinstance(scene, bytes) or (isinstance(scene, str) and scene.lstrip().startswith("{"))


def text_of(scene: Scene, changes: Mapping[str, Any] | None = None) -> bytes:
    """The JSON text of a scenario, with the values of `changes` put in by their pointers."""
    if isinstance(scene, bytes):
        text = scene
    elif isinstance(scene, str) and is_text(scene):
        text = scene.encode()
    elif isinstance(scene, (str, os.PathLike)):
        with open(scene, "rb") as file:
            text = file.read(LARGEST_BYTES + 1)
        if len(text) > LARGEST_BYTES:
            raise ScenarioError("", f"is longer than the {LARGEST_BYTES >> 20} MiB that are allowed")
    elif isinstance(scene, Mapping):
        text = dumped(dict(scene))
    else:
        raise TypeError(f"a path, JSON or a dict is needed, not {type(scene).__name__}")
    if changes:
        text = _native.with_changes(text, dumped(dict(changes)))
    return text


def dumped(value: Any) -> bytes:
    try:
        return json.dumps(value, default=plain).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise ScenarioError("", f"is no JSON: {error}") from error
