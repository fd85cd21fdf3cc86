"""Frozen dataclasses that are pytrees: `pytree` decorates a class, `static` marks a field that is not traced, `shared`
one without a row for each Gaussian.

`jax.tree_util.register_dataclass` is not used: JAX 0.10 to 0.12 considers the structures of two such classes equal if
only the classes differ, so that `jax.jit` may run the program of a class for its subclass. Classes registered with
their own functions are distinct.
"""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar, dataclass_transform, overload

import jax
import jax.numpy as jnp
import numpy as np

T = TypeVar("T")
MARK = "_registered_pytree"


def static(*, default: object = dataclasses.MISSING) -> Any:
    """Return a field that chooses shapes or code, and is not traced. Its values must be hashable.

    Args:
      default: its default value; none if left out.

    Returns:
      A field for a class that `pytree` decorates.
    """
    return dataclasses.field(default=default, metadata={"static": True})


def shared(*, default: object = None) -> Any:
    """Return a field of arrays that all Gaussians share, such as the weights of a network, a codebook or a hash grid.

    Events and other changes of rows leave it unchanged. Its floats are trained like other fields, and count once in the
    bytes of a model.

    Args:
      default: its default value; None, as in the template of an appearance, if left out.

    Returns:
      A field, for an array or any pytree of arrays, for a class that `pytree` decorates.
    """
    return dataclasses.field(default=default, metadata={"shared": True})


@jax.tree_util.register_pytree_with_keys_class
class Shared:
    """Node of a pytree around the arrays of a `shared` field, which have no row for each Gaussian.

    `core.table.map_rows` leaves it unchanged.
    """

    def __init__(self, tree: Any):
        """Args:
        tree: arrays, or any pytree of them.
        """
        self.tree = tree

    def tree_flatten_with_keys(self) -> tuple[tuple[tuple[str, Any]], None]:
        """Return the content under an empty key: paths in errors and files name the field only."""
        return (("", self.tree),), None

    @classmethod
    def tree_unflatten(cls, _: None, children: Sequence[Any]) -> "Shared":
        """Return the node around its only child."""
        return cls(*children)


def is_shared(node: object) -> bool:
    """Return whether a node of a pytree is shared by all rows, for `is_leaf` of `jax.tree`."""
    return isinstance(node, Shared)


def beside(*, default: object = dataclasses.MISSING) -> Any:
    """Return a field outside the pytree: results of transformations have its default instead, or None without one."""
    return dataclasses.field(default=default, metadata={"beside": True})


@overload
@dataclass_transform(frozen_default=True, field_specifiers=(static, shared, beside, dataclasses.field))
def pytree(cls: type[T], /) -> type[T]: ...
@overload
def pytree(*, kw_only: bool = False, repr: bool = True) -> Callable[[type[T]], type[T]]: ...


def pytree(cls: Any = None, /, **options: Any) -> Any:
    """Decorate a class: make it a frozen dataclass and a pytree of its fields, except static ones.

    Transformations of JAX build instances without calling `__init__` and `__post_init__`, so that these may check and
    convert what a caller gives. Two instances are equal if their fields are, arrays by shape and values. Only instances
    without arrays can be hashed.

    Args:
      cls: the class, whose bases may be decorated as well.
      **options: options of `dataclasses.dataclass`, such as `kw_only=True`.

    Returns:
      The class.
    """
    if cls is None:
        return lambda decorated: pytree(decorated, **options)
    equality = vars(cls).get("__eq__", _are_equal)
    made = dataclasses.dataclass(frozen=True, **options)(cls)
    made.__eq__ = equality
    _name_replace(made)
    fields = dataclasses.fields(made)
    fixed = tuple(field.name for field in fields if field.metadata.get("static"))
    common = {field.name for field in fields if field.metadata.get("shared")}
    left_out: dict[str, object] = {}
    for field in fields:
        if field.metadata.get("beside"):
            left_out[field.name] = None if field.default is dataclasses.MISSING else field.default
    dynamic = tuple(field.name for field in fields if field.name not in {*fixed, *left_out})
    # For errors, which name a leaf by its path, such as params.gaussians.means.
    keys = tuple(jax.tree_util.GetAttrKey(name) for name in dynamic)

    def flatten(node: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        values = node.__dict__
        children = tuple(Shared(values[name]) if name in common else values[name] for name in dynamic)
        return children, tuple(values[name] for name in fixed)

    def flatten_with_keys(node: object) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        children, values = flatten(node)
        return tuple(zip(keys, children, strict=True)), values

    def unflatten(values: tuple[object, ...], children: Iterable[object]) -> Any:
        node = object.__new__(made)
        # Through `__dict__`, because fields of a frozen dataclass cannot be assigned.
        node.__dict__.update(zip(dynamic, children, strict=True))
        for name in common:
            # JAX also passes placeholders, which are not from `flatten`.
            if isinstance(node.__dict__[name], Shared):
                node.__dict__[name] = node.__dict__[name].tree
        node.__dict__.update(zip(fixed, values, strict=True))
        node.__dict__.update(left_out)
        return node

    jax.tree_util.register_pytree_with_keys(made, flatten_with_keys, unflatten, flatten)
    setattr(made, MARK, made)
    return made


def _name_replace(cls: Any) -> None:
    """Let the error of an assignment to a field say how to make a changed copy."""
    refuse = cls.__setattr__

    def __setattr__(self: Any, name: str, value: object) -> None:
        try:
            refuse(self, name, value)
        except dataclasses.FrozenInstanceError:
            names = [field.name for field in dataclasses.fields(self)]
            hint = f"make a changed copy: dataclasses.replace(old, {name}=...)"
            if name not in names:
                hint = f"it has no field {name}, only {', '.join(names)}"
            raise dataclasses.FrozenInstanceError(f"{type(self).__name__} cannot be changed; {hint}") from None

    cls.__setattr__ = __setattr__


def _are_equal(self: Any, other: Any) -> Any:
    """Compare two instances field by field, as dataclasses do, but arrays as a whole."""
    if type(other) is not type(self):
        return NotImplemented
    names = [field.name for field in dataclasses.fields(self)]
    values = [getattr(self, name) for name in names]
    others = [getattr(other, name) for name in names]
    structure: Any = jax.tree.structure(values)
    if structure != jax.tree.structure(others):
        return False
    return all(map(_are_equal_leaves, jax.tree.leaves(values), jax.tree.leaves(others)))


def _are_equal_leaves(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray | jax.Array) or isinstance(b, np.ndarray | jax.Array):
        # `asarray` raises for tracers; `array_equal` would catch the error and call them unequal.
        return a is b or np.array_equal(np.asarray(a), np.asarray(b))
    return a is b or bool(a == b)


def check_pytree(name: str, value: object) -> None:
    """Raise ValueError unless `pytree` decorates the class of a value and of each dataclass in it."""
    nodes: list[Any] = [jax.tree.structure(value)]
    kinds = {type(leaf) for leaf in jax.tree.leaves(value) if leaf is value or dataclasses.is_dataclass(leaf)}
    while nodes:
        node = nodes.pop()
        data = node.node_data()
        if data:
            kinds.add(data[0])
            nodes += node.children()
    for kind in kinds:
        is_other = dataclasses.is_dataclass(kind) or (kind is type(value) and not issubclass(kind, tuple | list | dict))
        # `__dict__`, not getattr: an undecorated subclass inherits the mark of its base.
        if is_other and kind.__dict__.get(MARK) is not kind:
            raise ValueError(f"{name} must be a pytree: decorate the class {kind.__name__} with @a2tg_jax.pytree")


# Training differentiates and changes the floats of a pytree. `partition` separates them from the rest, integers such as
# the places of textures, which `jax.grad` rejects.
#
#     floats, rest = partition(model)
#     gradient = jax.grad(lambda floats: loss(combine(floats, rest)))(floats)


def partition(tree: T) -> tuple[T, T]:
    """Split a pytree into its float arrays and the rest, as `jax.grad` needs it.

    Args:
      tree: any pytree, such as a model.

    Returns:
      Two pytrees of the structure of `tree`: one with None for all leaves but floats, and one with None for the floats.
    """

    def is_float(leaf: object) -> bool:
        dtype = getattr(leaf, "dtype", None)
        return isinstance(leaf, float) if dtype is None else jnp.issubdtype(dtype, jnp.floating)

    floats: T = jax.tree.map(lambda leaf: leaf if is_float(leaf) else None, tree)
    rest: T = jax.tree.map(lambda leaf: None if is_float(leaf) else leaf, tree)
    return floats, rest


def combine(floats: T, rest: T) -> T:
    """Return the pytree that `partition` split, or one with other floats.

    Args:
      floats: the first pytree of `partition`, or a changed one.
      rest: the second.

    Returns:
      A pytree of the same structure, with every leaf.
    """
    return jax.tree.map(
        lambda number, other: other if number is None else number, floats, rest, is_leaf=lambda leaf: leaf is None
    )
