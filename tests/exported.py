"""Names that modules export."""

from types import ModuleType

__all__ = ["names_of"]


def names_of(module: ModuleType) -> list[str]:
    """Names that a module lists in ``__all__``, or else all that it defines."""
    own = [
        name for name, thing in vars(module).items() if getattr(thing, "__module__", "") == module.__name__
    ]
    return list(getattr(module, "__all__", [name for name in own if not name.startswith("_")]))
