"""Scenes as Mitsuba parses them: its parser, its resolver of file names, its messages.

chdstat changes a scene between the two steps of Mitsuba's own loader: the parser has read and
transformed the description, but no object exists yet. A part of a scene, such as its sensor, can be
made alone, and again.

Only this module and `chdstat.rendering` import Mitsuba.
"""

from __future__ import annotations

import contextlib
import itertools
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mitsuba as mi
import mitsuba.parser
import numpy as np

from chdstat._core.files import is_file
from chdstat.errors import SceneError
from chdstat.scenes.faults import checked_mesh, filled, in_words, refuse_faults

if TYPE_CHECKING:
    from chdstat.scenes.scene import Scene

_MESHES = ("blender", "cube", "ellipsoidsmesh", "obj", "ply", "rectangle", "serialized")
"""Plugins that Mitsuba makes meshes of."""
_RESOLVING = threading.RLock()
"""Held while Mitsuba's resolver, which belongs to the process, is set for a scene."""


@dataclass(frozen=True)
class ParsedScene:
    """A scene description, or a part of one, as read by Mitsuba's parser.

    Parameters
    ----------
    name
        Name of the scene in errors.
    nodes
        The nodes, of which the first is the root. Each is an object of its own: in Mitsuba's list
        of nodes, all move in memory when one is added, and what referred to them would write
        anywhere.
    paths
        Place of each node in a scene dict, for Mitsuba's errors; empty for a file.
    origin
        Mitsuba's parser state without nodes, for its errors.
    resolver
        Resolver of the files that the description names.
    """

    name: str
    nodes: list[Any]
    paths: list[str]
    origin: Any
    resolver: Any

    @classmethod
    def of(cls, name: str, state: Any, resolver: Any) -> ParsedScene:
        """Return the scene of a state of Mitsuba's parser, and take its nodes away."""
        nodes, paths = [mi.parser.SceneNode(node) for node in state.nodes], list(state.node_paths)
        state.nodes.clear()
        return cls(name, nodes, paths, state, resolver)

    def node(self, index: int) -> Any:
        """Return a node by its number."""
        return self.nodes[index]

    def plugin(self, index: int) -> str:
        """Return the name of a node's plugin."""
        return str(self.node(index).props.plugin_name())

    def held(self, index: int, kind: str | None = None) -> list[int]:
        """Return the nodes that a node holds, optionally of one kind such as ``"Film"``."""
        found = [i for _, i in self.references(index)]
        return [i for i in found if kind in (None, self.node(i).type.name)]

    def drop(self, parts: Iterable[int]) -> None:
        """Remove some nodes from the nodes that hold them."""
        gone = set(parts)
        for holder in range(len(self.nodes)):
            for key, index in self.references(holder):
                if index in gone:
                    del self.node(holder).props[key]

    def sole(self, part: Mapping[str, Any]) -> ParsedScene:
        """Return the part that a dict in Mitsuba's form describes; files are found as here."""
        with _naming(self.name, "read"), _resolving(self.resolver):
            state = mi.parser.parse_dict(_config(), dict(part))
        return ParsedScene.of(self.name, state, self.resolver)

    def put(self, holder: int, key: str, part: Mapping[str, Any]) -> None:
        """Give a node a new part, from a dict in Mitsuba's form."""
        added, first = self.sole(part), len(self.nodes)
        self.add([_moved(node, lambda i: first + i) for node in added.nodes], added.paths)
        self.node(holder).props[key] = mi.Properties.ResolvedReference(first)

    def add(self, nodes: Iterable[Any], paths: Iterable[str]) -> None:
        """Add nodes, and their places in a scene dict."""
        self.nodes.extend(nodes)
        if self.paths:
            self.paths.extend(paths)

    def branch(self, root: int) -> ParsedScene:
        """Return a copy of a node and everything that it holds."""
        order = self._reached(root, first=0)
        nodes = [_moved(self.node(index), order.__getitem__) for index in order]
        paths = [self.paths[index] for index in order] if self.paths else []
        return ParsedScene(self.name, nodes, paths, self.origin, self.resolver)

    def unshare(self, kind: str) -> None:
        """Give each node of a kind such as ``"Emitter"`` its own copy of everything it holds."""
        for holder in range(len(self.nodes)):
            if self.node(holder).type.name != kind:
                continue
            for key, index in self.references(holder):
                order = self._reached(index, first=len(self.nodes))
                copies = [_moved(self.node(old), order.__getitem__) for old in order]
                self.add(copies, [self.paths[old] for old in order] if self.paths else [])
                self.node(holder).props[key] = mi.Properties.ResolvedReference(order[index])

    def _reached(self, root: int, *, first: int) -> dict[int, int]:
        """Return numbers from `first` on for a node and everything it holds, by their indices."""
        order: dict[int, int] = {}

        def visit(index: int) -> None:
            if index not in order:
                order[index] = first + len(order)
                for held in self.held(index):
                    visit(held)

        visit(root)
        return order

    def make(self, *, parallel: bool = False) -> Any:
        """Return the Mitsuba object of the root, with its models and textures read.

        Raises
        ------
        SceneError
            If a plugin, a model or a texture is missing or broken.
        """
        config = _config()
        config.parallel = parallel
        # Mitsuba puts the objects into the state: here, into a copy that ends with this call. After
        # a failure, lights would outlive their shapes, and end the process later.
        state = mi.parser.ParserState(self.origin)
        for node in self.nodes:
            state.nodes.append(node)
        state.node_paths = self.paths
        with _naming(self.name, "build", self.missing), _resolving(self.resolver):
            return mi.parser.instantiate(config, state)

    def missing(self) -> list[str]:
        """Return the names of files that parts of the scene name, and that are not there."""
        found = []
        for node in self.nodes:
            properties = mi.Properties(node.props)  # a copy: Mitsuba records what is read
            name = str(properties["filename"]) if "filename" in properties else ""
            if name and not is_file(Path(str(self.resolver.resolve(name)))):
                found.append(name)
        return sorted(set(found))

    def references(self, index: int) -> list[tuple[str, int]]:
        """Return the names and nodes of everything that a node holds."""
        resolved, props = mi.Properties.Type.ResolvedReference, self.node(index).props
        keys = [key for key in props.keys() if props.type(key) == resolved]  # noqa: SIM118
        return [(key, props[key].index()) for key in keys]


def _moved(node: Any, place: Callable[[int], int]) -> Any:
    """Return a copy of a node whose references point to the new places of its parts."""
    copy, resolved = mi.parser.SceneNode(node), mi.Properties.Type.ResolvedReference
    for key in list(copy.props.keys()):
        if copy.props.type(key) == resolved:
            index = place(copy.props[key].index())
            copy.props[key] = mi.Properties.ResolvedReference(index)
    return copy


def parse(scene: Scene) -> ParsedScene:
    """Return a scene as Mitsuba's parser reads it for the current variant.

    Raises
    ------
    SceneError
        If Mitsuba cannot read it; its message is passed on.
    """
    source = scene.description()
    # Mitsuba's names belong to the current variant, so a type checker cannot know them.
    mitsuba_now: Any = mi
    resolver = mitsuba_now.FileResolver(mitsuba_now.file_resolver())
    if not isinstance(source, Mapping):
        resolver.prepend(str(source.parent))
    config = _config()
    with _naming(scene.name, "read"), _resolving(resolver):
        if isinstance(source, Mapping):
            state = mi.parser.parse_dict(config, _to_mitsuba(source))
        else:
            state = mi.parser.parse_file(config, str(source), **dict(scene.parameters))
        mi.parser.transform_all(config, state)
    parsed = ParsedScene.of(scene.name, state, resolver)
    with _resolving(resolver):
        refuse_faults(parsed)
    parsed.unshare("Emitter")  # equal textures are one object, but lights are darkened one by one
    _expand(parsed)
    _merge(parsed)
    return parsed


def _expand(parsed: ParsedScene) -> None:
    """Order the parts of a scene as Mitsuba's loader does, so that its sensors keep their numbers.

    The loader merges the whole scene: the content of merges follows after the rest, then meshes.
    """
    root, merges = parsed.node(0).props, _keyed(parsed, "merge")
    for key in merges:
        index = root[key].index()
        merge = parsed.node(index).props
        names = list(merge.keys())
        if len(names) != 1:
            del root[key]
        places = {n: _unused(root, f"{key}_{n}") if len(names) > 1 else key for n in names}
        for name, place in places.items():
            root[place] = merge[name]
        merges += [places[n] for n, i in parsed.references(index) if parsed.plugin(i) == "merge"]
    for key in _keyed(parsed, *_MESHES):
        if parsed.held(root[key].index(), "Sensor"):
            part = root[key]
            del root[key]
            root[key] = part


def _keyed(parsed: ParsedScene, *plugins: str) -> list[str]:
    """Return the names of a scene's parts that some plugins make."""
    return [key for key, index in parsed.references(0) if parsed.plugin(index) in plugins]


def _unused(properties: Any, name: str, first: int = 0) -> str:
    """Return a name with a number that no property has."""
    return next(n for i in itertools.count(first) if (n := f"{name}_{i}") not in properties)


def _merge(parsed: ParsedScene) -> None:
    """Merge meshes of one material, as Mitsuba's loader does, but in a fixed order.

    Mitsuba orders materials by their place in memory, and lights with them. The same random numbers
    would then choose other lights in each process. Here, each material is merged separately, and
    lights are not merged.
    """
    groups: dict[tuple[Any, ...], dict[str, int]] = {}
    for key, index in parsed.references(0):
        held = parsed.held(index)
        kinds = {parsed.node(i).type.name for i in held}
        if parsed.node(index).type.name == "Shape" and kinds and kinds <= {"BSDF", "Medium"}:
            flat = parsed.node(index).props.get("face_normals", False)
            group = (parsed.plugin(index), flat, *sorted(held))
            groups.setdefault(group, {})[key] = index
    root = parsed.node(0).props
    for meshes in (group for group in groups.values() if len(group) > 1):
        merged = mi.parser.SceneNode()
        merged.type = mi.ObjectType.Shape
        merged.props.set_plugin_name("merge")
        for key, index in meshes.items():
            merged.props[key] = mi.Properties.ResolvedReference(index)
            del root[key]
        name = _unused(root, "_merged", len(parsed.nodes))
        root[name] = mi.Properties.ResolvedReference(len(parsed.nodes))
        parsed.add([merged], [name])


def _config() -> Any:
    """Return the settings of Mitsuba's loader, without the merging of meshes; see `_merge`."""
    config = mi.parser.ParserConfig(str(mi.variant()))
    config.merge_meshes = False
    return config


@contextlib.contextmanager
def _naming(scene: str, doing: str, missing: Callable[[], Sequence[str]] = tuple) -> Iterator[None]:
    """Turn Mitsuba's errors about a scene into an error that names the scene."""
    try:
        yield
    except (RuntimeError, ValueError, TypeError) as error:  # ValueError: text that is no UTF-8
        message = f"Mitsuba cannot {doing} the scene {scene!r}{in_words(error, missing())}"
        raise SceneError(message) from error


@contextlib.contextmanager
def _resolving(resolver: Any) -> Iterator[None]:
    """Let Mitsuba look for files in a scene's places, while the context lasts."""
    mitsuba_now: Any = mi
    with _RESOLVING:
        previous = mitsuba_now.file_resolver()
        mitsuba_now.set_file_resolver(resolver)
        try:
            yield
        finally:
            mitsuba_now.set_file_resolver(previous)


def _to_mitsuba(value: Any, *, key: str = "") -> Any:
    """Convert a plain value, and the values in it, for Mitsuba's dict parser."""
    if isinstance(value, Mapping):
        if value.get("type") == "mesh":
            return _mesh(value, name=key)
        if value.get("type") == "bitmap" and isinstance(value.get("data"), np.ndarray):
            return _bitmap(value)
        return {name: _to_mitsuba(item, key=name) for name, item in value.items()}
    if value is None:
        message = f"a scene dict holds None for {key!r}; leave out what has no value"
        raise SceneError(message)
    filled(key, value)
    if isinstance(value, np.ndarray) and value.shape == (4, 4):
        return mi.ScalarTransform4f(value)
    if isinstance(value, np.ndarray) and value.shape == (3, 3):
        return mi.ScalarTransform3f(value)
    if isinstance(value, np.ndarray):
        return value.tolist()
    # These belong to one variant, and Mitsuba takes the content of tensors away.
    if (kind := type(value).__name__) == "TensorXf":
        return getattr(mi, kind)(np.array(value))
    if kind == "VolumeGrid":
        stream = mi.MemoryStream()
        value.write(stream)
        stream.seek(0)
        return getattr(mi, kind)(stream)
    return value


def _mesh(spec: Mapping[str, Any], *, name: str) -> Any:
    """Return a mesh object: Mitsuba's dict has no plugin for vertices in memory."""
    vertices, faces, normals, uv = checked_mesh(spec, name)
    properties = mi.Properties()
    for part in ("bsdf", "emitter"):
        if part in spec:
            properties[part] = mi.load_dict(_to_mitsuba(spec[part]))
    mesh = mi.Mesh(
        name,
        len(vertices),
        len(faces),
        props=properties,
        has_vertex_normals=normals is not None,
        has_vertex_texcoords=uv is not None,
    )
    arrays = mi.traverse(mesh)
    arrays["vertex_positions"] = vertices.ravel()
    arrays["faces"] = faces.ravel()
    if normals is not None:
        arrays["vertex_normals"] = normals.ravel()
    if uv is not None:
        arrays["vertex_texcoords"] = uv.ravel()
    arrays.update()
    return mesh


def _bitmap(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Return a bitmap texture; `data` is linear, so it must not be taken for sRGB."""
    rest = {k: _to_mitsuba(v, key=k) for k, v in spec.items() if k != "data"}
    filled("data", spec["data"])
    image = mi.Bitmap(np.ascontiguousarray(spec["data"], dtype=np.float32))
    return {**rest, "bitmap": image, "raw": bool(spec.get("raw", image.channel_count() == 1))}
