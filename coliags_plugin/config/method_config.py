"""Method configs: files of the package or of others, by name, -> one validated, frozen :class:`MethodConfig`."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationInfo, field_validator, model_validator
from typing_extensions import Self

from coliags_plugin.config.reference import meanings, plain_doc
from coliags_plugin.config.yaml_tree import (
    Node,
    at_origins,
    deep_merge,
    dump,
    dump_inline,
    merge,
    nodes,
    override_all,
    parse_value,
    plain_value,
    read_tree,
)
from coliags_plugin.core import registry
from coliags_plugin.core.components import (
    Component,
    DataManagerNode,
    FieldNode,
    LossNode,
    ModuleNode,
    RendererNode,
    SamplerNode,
    StrategyNode,
    components_of,
    make_component,
)
from coliags_plugin.core.errors import InputError, did_you_mean
from coliags_plugin.core.files import user_path
from coliags_plugin.core.intrinsics import NEAR_PLANE
from coliags_plugin.core.settings import Rates, Settings, refuse_zero_ends

#: A share of the run, strictly between its start and its end.
Share = Annotated[float, Field(gt=0, lt=1)]


class OptimizerSettings(Settings):
    """Adam for one parameter group of the field; the rate is constant, or log-linear to ``final_lr`` over the run.

    A constant rate of 0 freezes the group; one that falls needs both ends above 0. ``halve_at`` halves either.
    """

    lr: float = Field(ge=0)  # learning rate of Adam, at the first step
    final_lr: float | None = Field(default=None, ge=0)  # learning rate at the last step; null: as at the first
    times_extent: bool = False  # multiply both rates by the scene's extent (docs/methods.md 2.1)
    halve_at: tuple[Share, ...] = ()  # shares of the run, between 0 and 1, after each of which the rate is halved
    beta2: float = Field(default=0.999, ge=0, lt=1)  # Adam's decay of mean squared gradients: over 1/(1 - beta2) steps
    eps: float = Field(default=1e-15, gt=0)  # Adam's epsilon; the splatting methods' (docs/methods.md 2.3)

    @model_validator(mode="after")
    def _ends_above_zero(self) -> Self:
        refuse_zero_ends(self, "lr", "final_lr")
        return self


class ScheduleSettings(Settings):
    """Length of training, and intervals of logging and checkpoints."""

    steps: int = Field(default=30_000, ge=1)  # length of the run
    written_for: int = Field(default=30_000, ge=1)  # run length that step numbers elsewhere in the config mean
    log_every: int = Field(default=10, ge=1)  # steps between lines of metrics.jsonl
    checkpoint_every: int = Field(default=5_000, ge=1)  # steps between checkpoints; the last step has one, too


def default_rates(field: Component | None, modules: Mapping[str, Component]) -> Rates:
    """Learning rates that the components declare, by parameter group: a module's as ``<module>.<group>``."""
    of_modules = {f"{name}.{group}": rate for name, node in modules.items() for group, rate in node.rates.items()}
    return {**({} if field is None else field.rates), **of_modules}


#: Parts of a method that are one component, and its kind.
_SECTIONS = {"datamanager": "datamanagers", "field": "fields", "renderer": "renderers", "strategy": "strategies"}


class MethodConfig(Settings):
    """A method: named components and their settings, as in a run folder's ``config.yaml``."""

    description: str = ""  # one line; not inherited
    datamanager: DataManagerNode  # reads the data
    agreed_depth: bool = False  # whether the training depth is made what frames agree on (docs/methods.md 4.14)
    field: FieldNode  # what is trained
    renderer: RendererNode  # draws it
    near_plane: float = Field(default=NEAR_PLANE, ge=0)  # z-depth up to which nothing is drawn, scene units
    modules: dict[str, ModuleNode] = Field(default_factory=dict)  # what adjusts cameras and shades views, in this order
    sampler: SamplerNode = Field(default="frames", validate_default=True)  # what each step looks at
    strategy: StrategyNode  # grows and prunes
    losses: dict[str, LossNode] = Field(min_length=1)  # terms by a key of your choice
    # Adam by parameter group: a component's default rates, in which these are merged
    optimizers: dict[str, OptimizerSettings] = Field(default_factory=dict, validate_default=True)
    schedule: ScheduleSettings = ScheduleSettings()  # how long to train and how often to write
    protocol: str = "paper"  # evaluation protocol

    @field_validator("optimizers", mode="before")
    @classmethod
    def _over_defaults(cls, groups: object, info: ValidationInfo) -> object:
        return deep_merge(default_rates(info.data.get("field"), info.data.get("modules", {})), groups)

    @field_validator("losses", "optimizers", "modules", mode="before")
    @classmethod
    def _null_removes(cls, entries: object) -> object:
        if not isinstance(entries, dict):
            return entries
        return {key: value for key, value in entries.items() if value is not None}

    @field_validator("modules")
    @classmethod
    def _names_without_dots(cls, modules: dict[str, Component]) -> dict[str, Component]:
        for name in modules:
            if not name.isidentifier():
                raise ValueError(f"module name '{name}': expected letters, digits and underscores")
        return modules

    @field_validator("protocol")
    @classmethod
    def _known_protocol(cls, name: str) -> str:
        if name not in registry.protocols.names():
            names = ", ".join(registry.protocols.names())
            raise ValueError(f"no protocol '{name}'; known: {names}. {did_you_mean(name, registry.protocols.names())}")
        return name

    @classmethod
    def _meant(cls, key: str, data: Mapping[str, object]) -> str:
        for section, kind in _SECTIONS.items():
            with suppress(ValueError):  # a component with a problem of its own
                if key in type(make_component(kind, data.get(section)).settings).model_fields:
                    return f"Did you mean '{section}.{key}'?"
        return super()._meant(key, data)

    def components(self) -> set[tuple[str, str]]:
        """Kind and name of all components, those among the options of others and the protocol included."""
        return {(each.kind, each.name) for each in components_of(self)} | {("protocols", self.protocol)}

    def to_yaml(self) -> str:
        """The whole config, defaults included; itself a valid method config."""
        return dump(self.model_dump())


@dataclass(frozen=True)
class LoadedMethod:
    """A method config and where each of its values was written."""

    name: str
    config: MethodConfig
    tree: Node

    def annotated(self) -> str:
        """The resolved config as YAML, each value with where it comes from and what it means."""
        return "\n".join(_annotated(self.config, self.tree, "")) + "\n"


#: Name of a method, path of its file, or a mapping like that.
Method = str | Path | Mapping[str, Any]
#: Origin of the values of a method that is a mapping, and its name where it has none.
MAPPING = "mapping"


def method_text(method: Method) -> str:
    """A method as options hold it: its name, the path of its file, or of a mapping, YAML in one line.

    A mapping may hold its ``name`` beside what a file holds; a relative path of its base is one here. InputError if it
    is none of these, or the mapping holds something that YAML does not.
    """
    if isinstance(method, (str, Path)):
        return str(method)
    if not isinstance(method, Mapping):
        raise InputError(f"method {method!r}", 'a name, the path of a YAML file, or a mapping, {"base": "coliags"}')
    base = str(method.get("base"))
    return dump_inline(plain_value({**method, "base": user_path(base).resolve()} if is_path(base) else method, MAPPING))


def is_text(method: str) -> bool:
    """True for what :func:`method_text` makes of a mapping, not a name or path."""
    return method.startswith("{")


def load_method(method: str, overrides: Iterable[str] = (), data_format: str | None = None) -> LoadedMethod:
    """Resolve a method config by its name (``coliags``, ``ablations/imia``), the path of a YAML file, or its text.

    ``key.path=value`` overrides are applied last. A data format is the name of a data manager that takes the place of
    the method's, with all its options.
    """
    tree = method_tree(method, overrides)
    if data_format is not None:
        tree = _with_data_format(tree, data_format)
    with at_origins(tree):
        config = MethodConfig.model_validate(tree.plain())
    return LoadedMethod(method_name(method), config, tree)


def _with_data_format(tree: Node, data_format: str) -> Node:
    """The tree with another name of the data manager, whose options stay."""
    manager = tree.find(["datamanager"])
    options = manager.value if manager.is_mapping else {}
    name = Node(data_format, "recognised from the data, or `data_format`")
    return Node({**tree.value, "datamanager": Node({**options, "name": name}, manager.origin)}, tree.origin)


def method_name(method: str) -> str:
    """Name of a method, of its file without the suffix, or within its text."""
    if is_text(method):
        return str(nodes(parse_value(method), MAPPING).value.get("name", Node(MAPPING, "")).value)
    return Path(method).stem if is_path(method) else method


def method_tree(method: str, overrides: Iterable[str] = ()) -> Node:
    """Merged config tree of a method with overrides applied, before validation, each value with its origin."""
    return override_all(_resolve(method, Path.cwd(), ()), overrides)


def _find(method: str, folder: Path, descendants: tuple[Path, ...]) -> Path:
    if is_path(method):
        path = Path(os.path.abspath(folder / user_path(method)))
        if not path.is_file():
            known = [file.name for file in path.parent.glob("*.y*ml") if file not in descendants] + [*method_files()]
            hint = did_you_mean(path.name, known) or "See `coliags list methods`"
            raise InputError(f"no file {path}", "a method config, or the name of a method without suffix", hint)
        return path
    files = method_files()
    if method not in files:
        raise InputError(
            f"no method '{method}'",
            f"one of {', '.join(sorted(files))}, or the path of a .yaml file",
            did_you_mean(method, files),
        )
    return files[method]


def _resolve(method: str, folder: Path, descendants: tuple[Path, ...]) -> Node:
    if is_text(method):
        tree = nodes(parse_value(method), MAPPING)
        tree.value.pop("name", None)
    else:
        path = _find(method, folder, descendants)
        if path in descendants:
            chain = " -> ".join(p.name for p in (*descendants, path))
            raise InputError(f"method configs inherit from each other: {chain}", "a chain of bases that ends")
        tree, folder, descendants = read_tree(path), path.parent, (*descendants, path)
    base = tree.value.get("base")
    if base is None:
        return tree
    if not isinstance(base.value, str):
        raise InputError(f"{base.origin}: base is {base.plain()!r}", "the name or path of a method config")
    try:
        parent = _resolve(base.value, folder, descendants)
    except InputError as error:
        raise InputError(f"{base.origin}: base: {error.seen}", error.expected, error.do) from error
    inherited = {key: node for key, node in parent.value.items() if key != "description"}
    overriding = {key: node for key, node in tree.value.items() if key != "base"}
    return merge(Node(inherited, parent.origin), Node(overriding, tree.origin))


def _annotated(part: Component | Settings | Mapping[str, Any], node: Node, indent: str) -> Iterator[str]:
    for key, value, meaning in _entries(part):
        child = node.value.get(key) if node.is_mapping else None
        if isinstance(value, (Component, Settings)) or (isinstance(value, dict) and value):
            yield f"{indent}{key}:" + (f"  # {meaning}" if meaning else "")
            bare = {} if child is None else {"name": child}
            yield from _annotated(value, child if child and child.is_mapping else Node(bare, ""), f"{indent}  ")
        else:
            origin = "default" if child is None else child.origin
            yield f"{indent}{key}: {dump_inline(value)}  # {': '.join(filter(None, (origin, meaning)))}"


def _entries(part: Component | Settings | Mapping[str, Any]) -> Iterator[tuple[str, Any, str]]:
    """Key, value and meaning of everything in a part of a config."""
    if isinstance(part, Component):
        yield "name", part.name, plain_doc(part.target, "\n")
        part = part.settings
    told = {} if isinstance(part, Mapping) else meanings(type(part))
    yield from ((key, value, told.get(key, "")) for key, value in (part.items() if isinstance(part, Mapping) else part))


#: Entry points whose name is a method's, and whose value is the package that holds ``<name>.yaml``.
ENTRY_POINTS = "coliags_plugin.methods"
#: Folder among the shipped method configs that holds benchmarks and ablations instead.
BENCHMARKS = "benchmarks"


def method_files() -> dict[str, Path]:
    """Files of all methods, ablations included, by name."""
    root = method_folder()
    paths = [path.relative_to(root) for path in root.rglob("*.yaml")]
    files = {path.with_suffix("").as_posix(): root / path for path in paths if path.parts[0] != BENCHMARKS}
    for entry in registry.installed(ENTRY_POINTS):
        if entry.name in files:
            raise InputError(
                f"method '{entry.name}' of package {entry.value} is already there: {files[entry.name]}",
                "one method per name",
                "Rename one of the two",
            )
        files[entry.name] = _file_in(entry.value, entry.name)
    return files


def method_folder() -> Path:
    """Folder of the shipped method configs: inside the wheel, or beside the package in a checkout."""
    package = Path(__file__).parents[1]
    in_wheel = package / "method_configs"
    return in_wheel if in_wheel.is_dir() else package.parent / "method_configs"


def is_path(name: str) -> bool:
    """True for the path of a YAML file, not a name."""
    return name.endswith((".yaml", ".yml"))


def descriptions(files: Mapping[str, Path]) -> dict[str, str]:
    """The description, one line, of every file by name, sorted."""
    texts = {name: read_tree(path).value.get("description") for name, path in sorted(files.items())}
    return {name: "" if text is None else str(text.value) for name, text in texts.items()}


def _file_in(package: str, name: str) -> Path:
    """The file of a method in another package, which is not imported."""
    spec = find_spec(package)
    folders = list(spec.submodule_search_locations or []) if spec is not None else []
    for folder in folders:
        if (Path(folder) / f"{name}.yaml").is_file():
            return Path(folder) / f"{name}.yaml"
    raise InputError(
        f"entry point '{name}' in {ENTRY_POINTS} names package {package}, which has no {name}.yaml",
        "a package with that file",
        "Correct or uninstall it",
    )
