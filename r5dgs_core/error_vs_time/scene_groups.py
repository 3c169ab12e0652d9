"""Groups of runs that differ only in seed or number of threads, and the names of these groups."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_IGNORED = {"train.seed", "train.threads"}  # keys of the configuration that may differ within a group


def identity(name: str, provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Return the common properties of the runs of a group: scene name, digest of the data, configuration by key."""
    sections = provenance.get("config") or {}
    keys = {f"{section}.{key}": value for section, values in sections.items() for key, value in values.items()}
    shared = {key: value for key, value in keys.items() if key not in _IGNORED}
    return {"name": name, "data": provenance.get("dataset_digest"), **shared}


def by_name(identities: Mapping[str, dict[str, Any]]) -> dict[str, list[str]]:
    """Group runs with equal identities.

    Args:
        identities: `identity` of each run, by its place.

    Returns:
        Places by the name of the group: that of the scene, with the differing settings if several groups have it.
    """
    groups: list[tuple[dict[str, Any], list[str]]] = []
    for place, own in identities.items():
        for shared, places in groups:
            if shared == own:
                places.append(place)
                break
        else:
            groups.append((own, [place]))
    found: dict[str, list[str]] = {}
    for own, places in groups:
        alike = [other for other, _ in groups if other["name"] == own["name"]]
        keys = [k for k in own if k != "data" and any(other.get(k) != own[k] for other in alike)]
        name = ", ".join([own["name"], *(f"{key} {own[key]}" for key in keys[:3])])
        while name in found:  # other data, or settings beyond the named ones
            name += "'"
        found[name] = places
    return found
