"""Details of a scene that are visible only from the ground: clouds, grain of the ground, leaves, window panes.

The drone and the satellite are too far away to see them. All functions edit Blender's node trees.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

_DAYLIGHT = (
    1.6  # more light from the sky than the drone's scenes have: walls in the shade fill pictures from the ground
)
_GRAIN = 25.0  # metres at which the grain of the ground fades out, where it would be finer than pixels


def open_sky(world: Any, phase: float, cover: float) -> None:
    """Add clouds to the visible sky.

    Args:
        phase: seed of the clouds.
        cover: fraction of the sky they fill, 0 to 1.
    """
    nodes, links = world.node_tree.nodes, world.node_tree.links
    light = nodes["Background"]
    light.inputs["Strength"].default_value *= _DAYLIGHT
    sky = light.inputs["Color"].links[0].from_socket
    direction = nodes.new("ShaderNodeTexCoord").outputs["Generated"]
    apart = nodes.new("ShaderNodeSeparateXYZ")
    links.new(direction, apart.inputs[0])
    # Clouds lie in a plane overhead: towards the horizon they crowd together.
    high = _math(nodes, links, "ADD", apart.outputs["Z"], 0.12)
    across = [_math(nodes, links, "DIVIDE", apart.outputs[axis], high) for axis in ("X", "Y")]
    place = nodes.new("ShaderNodeCombineXYZ")
    links.new(across[0], place.inputs["X"])
    links.new(across[1], place.inputs["Y"])
    place.inputs["Z"].default_value = phase
    clouds = nodes.new("ShaderNodeTexNoise")
    clouds.inputs["Scale"].default_value = 0.55
    clouds.inputs["Detail"].default_value = 6.0
    clouds.inputs["Roughness"].default_value = 0.6
    links.new(place.outputs[0], clouds.inputs["Vector"])
    edge = 0.66 - 0.3 * cover
    thick = _range(nodes, links, clouds.outputs[0], edge, edge + 0.16, 0.0, 0.9)
    fading = _range(nodes, links, apart.outputs["Z"], 0.02, 0.2, 0.25, 1.0)
    share = _math(nodes, links, "MULTIPLY", thick, fading)
    seen = nodes.new("ShaderNodeBackground")
    white = nodes.new("ShaderNodeBackground")
    links.new(sky, seen.inputs["Color"])
    seen.inputs["Strength"].default_value = light.inputs["Strength"].default_value
    white.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    white.inputs["Strength"].default_value = 1.5
    dome = _mixed(nodes, links, share, seen.outputs[0], white.outputs[0])
    ray = nodes.new("ShaderNodeLightPath").outputs["Is Camera Ray"]
    links.new(_mixed(nodes, links, ray, light.outputs[0], dome), nodes["World Output"].inputs["Surface"])


def grain(ground: Any) -> None:
    """Vary the ground's colour near the camera at a scale below its texture's pixels."""
    nodes, links = ground.node_tree.nodes, ground.node_tree.links
    base = nodes["Principled BSDF"].inputs["Base Color"]
    painted = base.links[0].from_socket
    fine = nodes.new("ShaderNodeTexNoise")
    fine.inputs["Scale"].default_value = 6.0
    fine.inputs["Detail"].default_value = 5.0
    fine.inputs["Roughness"].default_value = 0.75
    links.new(nodes.new("ShaderNodeNewGeometry").outputs["Position"], fine.inputs["Vector"])
    distance = nodes.new("ShaderNodeCameraData").outputs["View Distance"]
    strength = _range(nodes, links, distance, 2.0, _GRAIN, 1.9, 0.0)
    swing = _math(nodes, links, "SUBTRACT", fine.outputs[0], 0.5)
    factor = _math(nodes, links, "ADD", _math(nodes, links, "MULTIPLY", swing, strength), 1.0)
    scaled = nodes.new("ShaderNodeVectorMath")
    scaled.operation = "SCALE"
    links.new(painted, scaled.inputs[0])
    links.new(factor, scaled.inputs["Scale"])
    links.new(scaled.outputs[0], base)


def refine(materials: Iterable[tuple[str, Any]]) -> None:
    """Cut leaves out of the quads of trees, and make panes shine; takes names and materials."""
    for name, material in materials:
        kind, _, style = name.partition(" ")
        if kind == "leaves":
            _leaves(material)
        elif kind == "wall" and style in ("punched", "sash", "ribbon", "glass"):
            _panes(material)


def _leaves(material: Any) -> None:
    nodes, links = material.node_tree.nodes, material.node_tree.links
    surface = nodes["Material Output"].inputs["Surface"]
    solid = surface.links[0].from_socket
    cells = nodes.new("ShaderNodeTexVoronoi")
    cells.inputs["Scale"].default_value = 7.0  # of some 14 cm
    links.new(nodes.new("ShaderNodeNewGeometry").outputs["Position"], cells.inputs["Vector"])
    gap = _math(nodes, links, "GREATER_THAN", cells.outputs["Distance"], 0.5)
    hole = nodes.new("ShaderNodeBsdfTransparent").outputs[0]
    links.new(_mixed(nodes, links, gap, solid, hole), surface)


def _panes(material: Any) -> None:
    """Make the dark pixels of a wall's texture reflect as panes."""
    nodes, links = material.node_tree.nodes, material.node_tree.links
    shader = nodes["Principled BSDF"]
    texture = next(node for node in nodes if node.bl_idname == "ShaderNodeTexImage").outputs["Color"]
    grey = nodes.new("ShaderNodeRGBToBW")
    links.new(texture, grey.inputs[0])
    links.new(_range(nodes, links, grey.outputs[0], 0.12, 0.25, 0.06, 0.85), shader.inputs["Roughness"])
    links.new(_range(nodes, links, grey.outputs[0], 0.12, 0.25, 0.9, 0.2), shader.inputs["Specular IOR Level"])


def _math(nodes: Any, links: Any, operation: str, value: Any, by: Any) -> Any:
    node = nodes.new("ShaderNodeMath")
    node.operation = operation
    links.new(value, node.inputs[0])
    if isinstance(by, float):
        node.inputs[1].default_value = by
    else:
        links.new(by, node.inputs[1])
    return node.outputs[0]


def _range(nodes: Any, links: Any, value: Any, low: float, high: float, start: float, end: float) -> Any:
    node = nodes.new("ShaderNodeMapRange")
    links.new(value, node.inputs["Value"])
    for name, number in (("From Min", low), ("From Max", high), ("To Min", start), ("To Max", end)):
        node.inputs[name].default_value = number
    return node.outputs[0]


def _mixed(nodes: Any, links: Any, share: Any, one: Any, other: Any) -> Any:
    node = nodes.new("ShaderNodeMixShader")
    links.new(share, node.inputs[0])
    links.new(one, node.inputs[1])
    links.new(other, node.inputs[2])
    return node.outputs[0]
