"""Options of earlier method configs that have moved ("Renamed options" in the changelog)."""

from __future__ import annotations

from coliags_plugin.config.yaml_tree import Node
from coliags_plugin.core.errors import InputError

#: Sections whose former options ``near`` and ``near_plane`` are ``near_plane`` of the method.
_HAD_NEAR_PLANE = ("renderer", "field")


def with_moved_options(tree: Node) -> Node:
    """A method config, as written in one file or assignment, with its near planes at their present place.

    Raises:
        InputError: It has several that differ.
    """
    if not tree.is_mapping:
        return tree
    top = dict(tree.value)
    planes = {"near_plane": top["near_plane"]} if "near_plane" in top else {}
    for section in _HAD_NEAR_PLANE:
        node = top.get(section)
        if node is None or not node.is_mapping:
            continue
        own = {f"{section}.{key}": node.value[key] for key in ("near", "near_plane") if key in node.value}
        if own:
            kept = {key: child for key, child in node.value.items() if f"{section}.{key}" not in own}
            top[section] = Node(kept, node.origin)
            planes |= own
    if len({plane.value for plane in planes.values()}) > 1:
        listed = " and ".join(f"{key} {plane.value} ({plane.origin})" for key, plane in planes.items())
        raise InputError(
            f"{listed}: earlier versions had several near planes, of which one is left",
            "one near_plane",
            "Leave one of them, or write near_plane: LENGTH at the top level",
        )
    for plane in planes.values():
        # Of the volume renderer, null left the start of rays to the field.
        top["near_plane"] = Node(0.0, plane.origin) if plane.value is None else plane
    return Node(top, tree.origin)
