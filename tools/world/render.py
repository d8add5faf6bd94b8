"""The city as a Blender scene, rendered by Cycles on the processor. The only module that needs the package bpy."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

import bpy
import cv2
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from lpn.core.arrays import Float32Array, Float64Array
from tools.world import meshes, paint, textures
from tools.world.cameras import Pose, SatelliteImage
from tools.world.city import SPECIES, VEHICLES, City, grid, middles, within_window
from tools.world.flight_plan import AerialPose
from tools.world.photo import Look, linear_of, srgb_of

SCALE = 0.25  # metres a pixel of the ground's texture
_VARIANTS = 4
_PAINTS = ((0.62, 0.62, 0.62), (0.02, 0.02, 0.022), (0.25, 0.26, 0.27), (0.09, 0.095, 0.1), (0.04, 0.07, 0.2),
           (0.3, 0.02, 0.02), (0.5, 0.5, 0.48), (0.16, 0.15, 0.13), (0.03, 0.08, 0.06), (0.7, 0.7, 0.7))  # fmt: skip


class BlenderScene:
    """The scene of a square window of the city on one day.

    Only one can exist at a time, because Blender's data is global.

    Args:
        x, y, size: middle and side of the window in metres.
        samples: light paths per pixel, before the denoiser.
        threads: processor threads, 0 for all.
    """

    def __init__(
        self, city: City, x: float, y: float, size: float, look: Look, samples: int, folder: Path, threads: int = 0
    ) -> None:
        self._city, self._look, self._folder = city, look, folder
        self._window = (x - size / 2, y - size / 2, x + size / 2, y + size / 2)
        bpy.ops.wm.read_factory_settings(use_empty=True)
        self._scene: Any = bpy.context.scene
        self._materials: dict[str, Any] = {}
        self._settings(samples, threads)
        self._sky()
        camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
        self._scene.collection.objects.link(camera)
        self._scene.camera = self._camera = camera
        self._ground(size)
        self._buildings()
        self._trees()
        self._vehicles()
        self._hedges()
        self._bridges()

    def frame(self, pose: Pose | AerialPose, width: int, height: int | None = None) -> Float32Array:
        """Render a drone picture: (height, width, 3) linear light; square without a height."""
        data = self._camera.data
        data.type = "PERSP"
        data.sensor_fit = "HORIZONTAL"
        data.angle = np.radians(pose.fov)
        self._aim(pose.axes(), (pose.x, pose.y, pose.z))
        return self._render(width, width if height is None else height)

    def sweep(self, sweep: SatelliteImage) -> Float32Array:
        """Render a satellite image: (pixels, pixels, 3) linear light."""
        self._look_down(sweep)
        return self._render(sweep.pixels, sweep.pixels)

    def heights(self, sweep: SatelliteImage) -> Float32Array:
        """Measure the height of the topmost surface in each pixel of a satellite image, (pixels, pixels) metres, to 4 mm.

        It is rendered: every surface shines by its height, and one path through each pixel's middle stores that light as it is.
        """
        low, high = -40.0, 220.0
        glow = bpy.data.materials.new("height")
        glow.use_nodes = True
        tree = glow.node_tree
        split = _node(tree, "SeparateXYZ", {0: _node(tree, "NewGeometry").outputs["Position"]})
        share = _node(tree, "MapRange", {"From Min": low, "From Max": high, "Value": split.outputs["Z"]})
        shine = _node(tree, "Emission", {"Color": share.outputs[0]})
        _set(tree, tree.nodes["Material Output"], {"Surface": shine.outputs[0]})
        layer, cycles, render = self._scene.view_layers[0], self._scene.cycles, self._scene.render
        usual = cycles.samples, cycles.film_exposure, cycles.pixel_filter_type, cycles.filter_width
        layer.material_override = glow
        self._scene.view_settings.view_transform = "Raw"
        cycles.samples, cycles.film_exposure, cycles.use_denoising = 1, 1.0, False
        cycles.pixel_filter_type, cycles.filter_width, render.dither_intensity = "BLACKMAN_HARRIS", 0.01, 0.0
        self._look_down(sweep)
        stored = self._stored(sweep.pixels, sweep.pixels)[..., 0]
        layer.material_override = None
        self._scene.view_settings.view_transform = "Standard"
        cycles.samples, cycles.film_exposure, cycles.pixel_filter_type, cycles.filter_width = usual
        cycles.use_denoising = True
        return (low + stored.astype(np.float32) * ((high - low) / 65535)).astype(np.float32)

    def _look_down(self, sweep: SatelliteImage) -> None:
        axes = sweep.axes()
        self._camera.data.type, self._camera.data.ortho_scale = "ORTHO", sweep.size
        self._aim(axes, tuple(np.array([sweep.x, sweep.y, sweep.z]) - axes[2] * 600))

    def _aim(self, axes: Float64Array, place: tuple[float, float, float]) -> None:
        right, up, forward = axes
        matrix = np.eye(4)
        matrix[:3, :3] = np.stack([right, up, -forward], axis=1)
        matrix[:3, 3] = place
        self._camera.matrix_world = Matrix(matrix.tolist())

    def _render(self, width: int, height: int) -> Float32Array:
        value = self._stored(width, height).astype(np.float32) / 65535
        return linear_of(value).astype(np.float32) * 4

    def _stored(self, width: int, height: int) -> NDArray[np.uint16]:
        """Render, and return what Blender stores, (height, width, 3)."""
        render = self._scene.render
        render.resolution_x, render.resolution_y = width, height
        file = self._folder / f"frame-{os.getpid()}.png"
        render.filepath = str(file)
        bpy.ops.render.render(write_still=True)
        stored = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        file.unlink()
        if stored is None:
            raise OSError(f"Blender left no picture at {file}")
        return np.asarray(stored[..., 2::-1], np.uint16)

    def _settings(self, samples: int, threads: int) -> None:
        render, cycles = self._scene.render, self._scene.cycles
        render.engine = "CYCLES"
        render.resolution_percentage = 100
        render.use_persistent_data = True
        render.image_settings.file_format = "PNG"
        render.image_settings.color_depth = "16"
        render.image_settings.color_mode = "RGB"
        render.image_settings.compression = 0
        render.threads_mode = "FIXED" if threads else "AUTO"
        if threads:
            render.threads = threads
        self._scene.view_settings.view_transform = "Standard"
        cycles.device = "CPU"
        cycles.samples = samples
        cycles.use_adaptive_sampling = False
        cycles.use_denoising = True
        cycles.denoiser = "OPENIMAGEDENOISE"
        cycles.denoising_prefilter = "FAST"
        cycles.seed = 1
        cycles.film_exposure = 0.25  # white surfaces stay below 1, `_render` takes it back
        cycles.max_bounces = 2
        cycles.diffuse_bounces = 2
        cycles.glossy_bounces = 1
        cycles.transmission_bounces = 0
        cycles.caustics_reflective = cycles.caustics_refractive = False

    def _sky(self) -> None:
        elevation, bearing = np.radians(self._look.sun)
        world = bpy.data.worlds.new("sky")
        self._scene.world = world
        world.use_nodes = True
        tree, kind = world.node_tree, "MULTIPLE_SCATTERING"
        sky = _node(tree, "TexSky", sky_type=kind, sun_disc=False, sun_elevation=elevation, sun_rotation=bearing)
        _set(tree, tree.nodes["Background"], {"Color": sky.outputs[0], "Strength": 0.06})
        light = bpy.data.lights.new("sun", "SUN")
        light.energy = 4.6
        light.angle = np.radians(0.6)
        light.color = (1.0, 0.94, 0.86)
        sun = bpy.data.objects.new("sun", light)
        # A lamp shines along its -z.
        towards = np.array(
            [np.cos(elevation) * np.sin(bearing), np.cos(elevation) * np.cos(bearing), np.sin(elevation)]
        )
        right = np.cross([0, 0, 1.0], towards)
        right /= np.linalg.norm(right)
        matrix = np.eye(4)
        matrix[:3, :3] = np.stack([right, np.cross(towards, right), towards], axis=1)
        sun.matrix_world = Matrix(matrix.tolist())
        self._scene.collection.objects.link(sun)

    def _seen(self, x: Float64Array, y: Float64Array, reach: float = 0.0) -> NDArray[np.int_]:
        return within_window(self._window, x, y, reach)

    def _ground(self, size: float) -> None:
        west, south, _, north = self._window
        colour, water = paint.ground(self._city, west, north, size, SCALE, self._look.season)
        image = self._image("ground", colour, 1 - water)
        at = np.linspace(0, size, int(np.ceil(size / 5.0)) + 1)
        vertices, quads = grid(self._city.terrain, west + at, south + at)
        mesh = bpy.data.meshes.new("ground")
        _fill(mesh, vertices, np.full(len(quads), 4, np.int32), quads.reshape(-1).astype(np.int32))
        uv = (vertices[quads.reshape(-1), :2] - (west, south)) / size
        mesh.uv_layers.new(name="uv").data.foreach_set("uv", uv.reshape(-1).astype(np.float32))
        mesh.materials.append(_ground_material(image))
        self._put(mesh, Matrix.Identity(4), "ground")

    def _buildings(self) -> None:
        city = self._city
        made: dict[int, Any] = {}
        for i in self._seen(*middles(city.buildings), 20):
            b = city.buildings[i]
            if b.architecture not in made:
                shape = meshes.building(city.architectures[b.architecture])
                made[b.architecture] = self._mesh(f"look {b.architecture}", shape)
            self._put(made[b.architecture], _matrix(b.x, b.y, city.height(b.x, b.y), b.angle), f"building {i}")

    def _trees(self) -> None:
        trees = self._city.trees
        rng = np.random.default_rng([self._city.seed, 11])
        shapes = [[self._mesh(f"tree {s} {v}", meshes.tree(s, rng)) for v in range(_VARIANTS)] for s in SPECIES]
        seen = self._seen(trees.x, trees.y)
        heights = self._city.terrain(np.stack([trees.x[seen], trees.y[seen]], axis=1))
        leaves = np.array(self._look.season.leaves)
        for i, z in zip(seen, heights, strict=True):
            look, size, kind = trees.look[i], trees.height[i], int(trees.species[i])
            shape = shapes[kind][int(look * _VARIANTS)]
            tree = self._put(shape, _matrix(trees.x[i], trees.y[i], z, look * 100, size), f"tree {i}")
            # Each species has its usual colour, each tree its own shade of it.
            choice = 2 if SPECIES[kind] == "fir" else int((look * 7.3 + kind * 0.37) % 1 * len(leaves))
            shade = 0.8 + 0.45 * (look * 31.7 % 1)
            tree.color = (*(leaves[choice] * shade * 1.45), 1.0)

    def _vehicles(self) -> None:
        stalls = self._city.stalls
        draw = np.random.default_rng([self._city.seed, 12, self._look.traffic])
        there = draw.random(len(stalls.x)) < stalls.chance
        colours = draw.integers(len(_PAINTS), size=len(stalls.x))
        shift = draw.normal(0, 0.25, (2, len(stalls.x)))
        shapes = [self._mesh(kind, meshes.vehicle(kind)) for kind in VEHICLES]
        seen = [i for i in self._seen(stalls.x, stalls.y) if there[i]]
        if not seen:
            return
        places = np.stack([stalls.x[seen] + shift[0, seen], stalls.y[seen] + shift[1, seen]], axis=1)
        heights = self._city.terrain(places)
        dry = self._city.terrain.bank(places) > 3
        for i, (x, y), z, keep in zip(seen, places, heights, dry, strict=True):
            if keep:
                kind = int(stalls.vehicle[i])
                vehicle = self._put(shapes[kind], _matrix(x, y, z, stalls.angle[i]), f"vehicle {i}")
                vehicle.color = (*_PAINTS[colours[i]], 1.0)

    def _hedges(self) -> None:
        hedges = self._city.hedges
        if not hedges:
            return
        middles = np.array([hedge.mean(axis=0) for hedge in hedges])
        rng = np.random.default_rng([self._city.seed, 13])
        styles = rng.random(len(hedges))
        mesh = meshes.Mesh()
        for i in self._seen(middles[:, 0], middles[:, 1]):
            a, b = hedges[i]
            length = float(np.linalg.norm(b - a))
            angle = float(np.arctan2(*(b - a)[::-1]))
            x, y = middles[i]
            z = self._city.height(x, y) - 0.5
            if styles[i] < 0.55:
                for share in np.arange(0.5, length, 1.0) / length:  # uneven, as hedges are
                    px, py = a + (b - a) * share
                    width, high = 0.8 + 0.5 * (styles[i] * 37 * share % 1), 1.9 + 0.5 * (styles[i] * 91 * share % 1)
                    tint = 0.7 + 0.5 * (styles[i] * 53 * share % 1)
                    mesh.box(px, py, z, 1.05, width, high, angle, "plain", (0.04 * tint, 0.065 * tint, 0.02 * tint))
            else:
                wood = (0.16, 0.12, 0.08) if styles[i] < 0.8 else (0.3, 0.28, 0.25)
                mesh.box(x, y, z, length, 0.15, 2.1, angle, "plain", wood)
        if mesh.sizes:
            self._put(self._mesh("hedges", mesh), Matrix.Identity(4), "hedges")

    def _bridges(self) -> None:
        for i, bridge in enumerate(self._city.bridges):
            if len(self._seen(np.array([bridge.x]), np.array([bridge.y]), bridge.length)):
                mesh = self._mesh(f"bridge {i}", meshes.bridge(bridge.length, bridge.width))
                self._put(mesh, _matrix(bridge.x, bridge.y, 0.12, bridge.angle), f"bridge {i}")

    def _put(self, mesh: Any, matrix: Any, name: str) -> Any:
        thing = bpy.data.objects.new(name, mesh)
        thing.matrix_world = matrix
        self._scene.collection.objects.link(thing)
        return thing

    def _mesh(self, name: str, shape: meshes.Mesh) -> Any:
        vertices, uv, sizes, tints = shape.arrays()
        mesh = bpy.data.meshes.new(name)
        _fill(mesh, vertices, sizes, np.arange(len(vertices), dtype=np.int32))
        mesh.uv_layers.new(name="uv").data.foreach_set("uv", uv.reshape(-1).astype(np.float32))
        names = list(dict.fromkeys(shape.materials))
        for each in names:
            mesh.materials.append(self._material(each))
        slots = np.array([names.index(each) for each in shape.materials], dtype=np.int32)
        mesh.polygons.foreach_set("material_index", slots)
        attribute = mesh.attributes.new("tint", "FLOAT_COLOR", "FACE")
        attribute.data.foreach_set(
            "color", np.column_stack([tints, np.ones(len(tints))]).reshape(-1).astype(np.float32)
        )
        return mesh

    def _material(self, name: str) -> Any:
        if name not in self._materials:
            kind, _, style = name.partition(" ")
            image = None
            if kind in ("wall", "roof") and style != "plain":
                texture = (textures.wall_texture if kind == "wall" else textures.roof_texture)(style)
                image = self._image(name, (texture / 2).astype(np.float32), None)
            self._materials[name] = _material(name, kind, image)
        return self._materials[name]

    def _image(self, name: str, colour: Float32Array, alpha: Float32Array | None) -> Any:
        """Make an sRGB image of linear colours in [0, 1] with an alpha channel."""
        encoded = srgb_of(colour)
        channels = [encoded[..., ::-1]] if alpha is None else [encoded[..., ::-1], alpha[..., None]]
        data = (np.clip(np.concatenate(channels, axis=-1), 0, 1) * 255 + 0.5).astype(np.uint8)
        file = self._folder / f"{name.replace(' ', '-')}-{os.getpid()}.png"
        cv2.imwrite(str(file), data, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        image = bpy.data.images.load(str(file))
        image.alpha_mode = "CHANNEL_PACKED"
        image.pack()
        file.unlink()
        return image


def _fill(mesh: Any, vertices: Float64Array, sizes: NDArray[np.int32], corners: NDArray[np.int32]) -> None:
    """Set the polygons of an empty Blender mesh: the number of corners of each, and the vertices of all corners in order."""
    mesh.vertices.add(len(vertices))
    mesh.vertices.foreach_set("co", vertices.reshape(-1).astype(np.float32))
    mesh.loops.add(len(corners))
    mesh.loops.foreach_set("vertex_index", corners)
    mesh.polygons.add(len(sizes))
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int32)
    mesh.polygons.foreach_set("loop_start", starts)
    mesh.update(calc_edges=True)


def _matrix(x: float, y: float, z: float, angle: float, size: float = 1.0) -> Any:
    return Matrix.Translation((x, y, z)) @ Matrix.Rotation(angle, 4, "Z") @ Matrix.Scale(size, 4)


def _set(tree: Any, node: Any, inputs: dict[str | int, Any]) -> None:
    """Set inputs of a node: sockets are linked, other values are constants."""
    for name, value in inputs.items():
        if isinstance(value, bpy.types.NodeSocket):
            tree.links.new(value, node.inputs[name])
        else:
            node.inputs[name].default_value = value


def _node(tree: Any, kind: str, inputs: dict[str | int, Any] | None = None, **settings: Any) -> Any:
    """Add a shader node with its settings and its inputs, see `_set`."""
    node = tree.nodes.new(f"ShaderNode{kind}")
    for name, value in settings.items():
        setattr(node, name, value)
    _set(tree, node, inputs or {})
    return node


def _material(name: str, kind: str, image: Any) -> Any:
    """Make a material of colour texture x tint, or object colour x tint for leaves and paint."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    tree, other = material.node_tree, None
    colour, shader = _node(tree, "Attribute", attribute_name="tint").outputs["Color"], tree.nodes["Principled BSDF"]
    if image is not None:
        texture = _node(tree, "TexImage", image=image).outputs["Color"]
        other = _node(tree, "VectorMath", {0: texture, "Scale": 2.0}, operation="SCALE").outputs[0]
    elif kind in ("leaves", "paint"):
        other = _node(tree, "ObjectInfo").outputs["Color"]
    if other is not None:
        colour = _node(tree, "VectorMath", {0: colour, 1: other}, operation="MULTIPLY").outputs[0]
    rough = {"glass": 0.12, "paint": 0.25}.get(kind, 0.85)
    shiny = {"glass": 0.9, "paint": 0.5, "leaves": 0.1}.get(kind, 0.2)
    _set(tree, shader, {"Base Color": colour, "Roughness": rough, "Specular IOR Level": shiny})
    if kind == "leaves":
        through = _node(tree, "BsdfTranslucent", {"Color": colour}).outputs[0]
        both = _node(tree, "MixShader", {0: 0.3, 1: shader.outputs[0], 2: through})
        _set(tree, tree.nodes["Material Output"], {"Surface": both.outputs[0]})
    return material


def _ground_material(image: Any) -> Any:
    """Make the painted ground, with water where its alpha is 0."""
    material = bpy.data.materials.new("ground")
    material.use_nodes = True
    tree = material.node_tree
    texture = _node(tree, "TexImage", image=image, extension="EXTEND")
    dry = texture.outputs["Alpha"]
    rough = _node(tree, "MapRange", {"Value": dry, "To Min": 0.12, "To Max": 0.9}).outputs[0]
    place = _node(tree, "NewGeometry").outputs["Position"]
    waves = _node(tree, "TexNoise", {"Vector": place, "Scale": 0.35}).outputs[0]
    wet = _node(tree, "Math", {0: 1.0, 1: dry}, operation="SUBTRACT").outputs[0]
    bump = _node(tree, "Bump", {"Distance": 0.25, "Strength": wet, "Height": waves}).outputs[0]
    colour, shader = texture.outputs["Color"], tree.nodes["Principled BSDF"]
    _set(tree, shader, {"Base Color": colour, "Roughness": rough, "Specular IOR Level": 0.3, "Normal": bump})
    return material


@contextmanager
def quiet() -> Iterator[TextIO]:
    """Keep the reports of Blender's C code off the terminal; yields a stream that still reaches it."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [os.dup(number) for number in (1, 2)]
    with Path(os.devnull).open("w") as nowhere, os.fdopen(os.dup(1), "w") as terminal:
        try:
            for number in (1, 2):
                os.dup2(nowhere.fileno(), number)
            yield terminal
        finally:
            for number, copy in zip((1, 2), kept, strict=True):
                os.dup2(copy, number)
                os.close(copy)
