"""Visual shapes of the scene as instances of meshes."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import DemorecError, RenderError
from demorec.episode.scene import Texture
from demorec.render import Visual, VisualBody, first_rows
from demorec.render.procedural import texture_pixels
from demorec.render.raster import primitives
from demorec.render.raster.decimate import decimated
from demorec.render.raster.kernels import layout
from demorec.render.raster.mesh import Floats, RasterMesh, cached_mesh, unit, weld
from demorec.render.raster.mesh_files import load_mesh
from demorec.render.raster.textures import Pixels, load_image, palette_colors


@dataclass(frozen=True, kw_only=True, eq=False)
class Piece:
    """One mesh, ready to be scaled and merged.

    Attributes:
        vertices: (v, 8) position, normal, texture coordinates (u, v).
        faces: (f, 3) rows of `vertices`.
        flags: (f,) layout.SMOOTH or 0, and layout.TEXTURED.
        groups: (f,) number, from 0, shared by faces of one colour and, if flat, one direction.
        colors: (f, 3) 0..1; white when textured.
        points, point_faces: (p, 3), (f, 3) positions alone, welded, for the shadow map.
    """

    vertices: Floats
    faces: NDArray[np.int64]
    flags: NDArray[np.int32]
    groups: NDArray[np.int64]
    colors: Floats
    points: Floats
    point_faces: NDArray[np.int64]

    def scaled_vertices(self, scale: Floats) -> Floats:
        """Scale each axis of the (v, 8) vertices and recompute their unit normals."""
        result = self.vertices.copy()
        result[:, :3] *= scale
        result[:, 3:6] = unit(result[:, 3:6] / scale)
        return result


def make_piece(mesh: RasterMesh, *, textured: bool) -> Piece:
    """Convert a mesh to vertices and faces for drawing."""
    n = mesh.num_faces
    uv = mesh.uv if textured and mesh.uv is not None else np.zeros((n, 3, 2))
    corners = np.concatenate([mesh.points[mesh.faces], mesh.normals, uv], 2).reshape(-1, 8)
    _, first, inverse = np.unique(corners.astype(np.float32), axis=0, return_index=True, return_inverse=True)
    flat = np.abs(mesh.normals - mesh.normals[:, :1]).max((1, 2)) < 1e-4
    colors = np.ones((n, 3)) if textured else mesh.colors
    direction = np.where(flat[:, None], np.round(mesh.normals[:, 0] * 50), 99)
    looks = np.concatenate([np.round(colors * 255), direction], 1)
    rows, point_inverse = weld(mesh.points)
    return Piece(
        vertices=corners[first],
        faces=inverse.reshape(-1, 3).astype(np.int64),
        flags=np.where(flat, 0, layout.SMOOTH).astype(np.int32) | (layout.TEXTURED if textured else 0),
        groups=np.unique(looks, axis=0, return_inverse=True)[1].reshape(-1),
        colors=colors,
        points=mesh.points[rows],
        point_faces=point_inverse[mesh.faces],
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """A mesh from a file or a primitive, before scaling.

    Attributes:
        key: Digest of its source: equal keys mean equal meshes.
        read: Reads all its triangles, which are not kept: those of a Panda take 17 MB.
        points: (v, 3) corners of all its triangles.
        num_faces: Number of all its triangles.
        has_uv: Whether it has texture coordinates.
        texture: Image that covers it, or None.
        coarse: Mesh of a primitive for the shadow map; primitives are always drawn whole.
    """

    key: str
    read: Callable[[], RasterMesh]
    points: Floats
    num_faces: int
    has_uv: bool
    texture: Path | None
    coarse: RasterMesh | None = None
    _pieces: dict[Any, Piece] = field(default_factory=dict)
    _spheres: dict[bytes, tuple[Floats, float]] = field(default_factory=dict)

    def piece(self, target: int | None, *, textured: bool) -> Piece:
        """Return the mesh with about `target` faces (None: all), prepared for drawing; computed once."""
        if self.coarse is not None:
            target = None
        place = (target, textured)
        if place not in self._pieces:
            mesh = self.read() if target is None else decimated(self.read, self.num_faces, target, key=self.key)
            self._pieces[place] = make_piece(mesh, textured=textured)
        return self._pieces[place]

    def caster(self, target: int) -> Piece:
        """Return the same for the shadow map, without textures."""
        if self.coarse is None:
            return self.piece(target, textured=False)
        if "caster" not in self._pieces:
            self._pieces["caster"] = make_piece(self.coarse, textured=False)
        return self._pieces["caster"]

    def bounding_sphere(self, scale: Floats) -> tuple[Floats, float]:
        """Compute centre (3,) and radius of a sphere around the scaled mesh."""
        place = scale.tobytes()
        if place not in self._spheres:
            points = self.points * scale
            centre = (points.min(0) + points.max(0)) / 2
            self._spheres[place] = centre, float(np.sqrt(((points - centre) ** 2).sum(1).max()))
        return self._spheres[place]


def _model_of(mesh: RasterMesh, *, key: str, read: Callable[[], RasterMesh], coarse: RasterMesh | None = None) -> Model:
    return Model(
        key=key,
        read=read,
        points=mesh.points,
        num_faces=mesh.num_faces,
        has_uv=mesh.uv is not None,
        texture=mesh.texture,
        coarse=coarse,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Instance:
    """One visual shape of the scene.

    Attributes:
        segment: Its number in segmentation images.
        row: Row of its link in the poses.
        model: Its mesh.
        scale: (3,) scale of the mesh.
        link_from_shape: (3, 4).
        color: (3,) 0..1.
        texture: Pixels, or None.
        stands: Whether physics cannot move it.
        has_links: Whether its body has links that extend around its base.
        centre, radius: Bounding sphere in the shape's frame.
    """

    segment: int
    row: int
    model: Model
    scale: Floats
    link_from_shape: Floats
    color: Floats
    texture: Pixels | None
    stands: bool
    has_links: bool
    centre: Floats
    radius: float

    def piece(self, target: int) -> Piece:
        """Return its mesh with about `target` faces, before scaling.

        Textured meshes keep all faces: decimation would destroy their texture coordinates.
        """
        return self.model.piece(None if self.texture is not None else target, textured=self.texture is not None)


@dataclass
class ModelStore:
    """Loaded meshes and textures, kept across scenes; changed files are read again."""

    _models: dict[tuple[Any, ...], Model] = field(default_factory=dict)
    _images: dict[tuple[Any, ...], Pixels] = field(default_factory=dict)

    def file(self, path: Path) -> Model:
        """Load the model of a mesh file; RenderError if it cannot be read."""
        try:
            stat = path.stat()
        except OSError as error:
            raise RenderError(f"The mesh file cannot be read ({error.strerror}): {path}") from error
        place = (str(path), stat.st_mtime_ns, stat.st_size)
        if place not in self._models:
            digest = _source_digest(path)
            mesh, key = self._read_file(path, digest)
            self._models[place] = _model_of(mesh, key=key, read=lambda: self._read_file(path, digest)[0])
        return self._models[place]

    def _read_file(self, path: Path, digest: str) -> tuple[RasterMesh, str]:
        """Read a mesh file, palette colours on its faces; returns the mesh, and the digest of file and texture."""
        mesh = cached_mesh(digest, lambda: load_mesh(path))
        if mesh.texture is None or mesh.uv is None:
            return mesh, digest
        image = self.image(mesh.texture)
        colors = palette_colors(mesh, image)
        key = digest + hashlib.sha256(image.tobytes()).hexdigest()
        return mesh if colors is None else replace(mesh, colors=colors, texture=None), key

    def primitive(self, name: str, *size: float) -> Model:
        """Make a box (x, y, z), sphere (radius), cylinder or capsule (radius, length)."""
        place = (name, *size)
        if place not in self._models:
            make: Any = getattr(primitives, name)
            mesh = coarse = make(*size)
            if name != "box":  # a box has no curved surface
                coarse = make(*size, segments=primitives.COARSE_SEGMENTS)
            self._models[place] = _model_of(mesh, key=repr(place), read=lambda: mesh, coarse=coarse)
        return self._models[place]

    def image(self, path: Path) -> Pixels:
        """Read a texture file's image."""
        try:
            place = (str(path), path.stat().st_mtime_ns)
        except OSError as error:
            raise RenderError(f"The texture cannot be read ({error.strerror}): {path}") from error
        if place not in self._images:
            self._images[place] = load_image(path)
        return self._images[place]


def _source_digest(path: Path) -> str:
    """Digest of a mesh file, its path (a mesh stores the path of its texture) and its materials."""
    data = path.read_bytes()
    digest = hashlib.sha256(f"{path} ".encode() + data)
    for line in re.findall(rb"^mtllib\s+(.+?)\s*$", data, re.MULTILINE):
        materials = path.parent / line.decode(errors="replace")
        if materials.is_file():
            digest.update(materials.read_bytes())
    return digest.hexdigest()


def make_instances(bodies: Sequence[VisualBody], store: ModelStore) -> list[Instance]:
    """Create the instances of the scene, static ones first.

    Raises:
        RenderError: A shape or texture cannot be drawn; the message names its body and link.
    """
    instances = []
    for number, (body, row) in enumerate(zip(bodies, first_rows(bodies), strict=True)):
        for visual in body.visuals:
            if visual.rgba[3] == 0:
                continue  # invisible
            try:
                model, scale = _model(visual, store)
                texture = _texture(model, body.texture, store)
            except DemorecError as error:
                raise RenderError(f"Body {number} ({body.name!r}), link {visual.link}: {error}") from error
            centre, radius = model.bounding_sphere(scale)
            instances.append(
                Instance(
                    segment=number + ((visual.link + 1) << 24),
                    row=row + 1 + visual.link,
                    model=model,
                    scale=scale,
                    link_from_shape=visual.link_from_shape.matrix()[:3].copy(),
                    color=np.array(visual.rgba[:3], dtype=np.float64),
                    texture=texture,
                    stands=visual.link == -1 and body.is_fixed,
                    has_links=body.num_links > 0,
                    centre=centre,
                    radius=radius,
                )
            )
    return sorted(instances, key=lambda instance: not instance.stands)


def _model(visual: Visual, store: ModelStore) -> tuple[Model, Floats]:
    """Return the model and its scale."""
    one, size = np.ones(3), visual.size
    match visual.kind:
        case "mesh":
            return store.file(Path(visual.file)), np.array(size)
        case "box":
            return store.primitive("box", 1.0, 1.0, 1.0), np.array(size)
        case "sphere":
            return store.primitive("sphere", 1.0), one * size[0]
        case "cylinder":
            return store.primitive("cylinder", 1.0, 1.0), np.array([size[0], size[0], size[1]])
        case "capsule":
            return store.primitive("capsule", size[0], size[1]), one


def _texture(model: Model, texture: Texture | None, store: ModelStore) -> Pixels | None:
    """Choose the image that covers a shape: one set on it, else the mesh file's."""
    if texture is not None and model.has_uv:
        return texture_pixels(texture)
    if model.texture is not None and model.has_uv:
        return store.image(model.texture)
    return None
