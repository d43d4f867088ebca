"""Tables and lists as JSON has them, which can be read and written down but not changed."""

from __future__ import annotations

from typing import Any

from ctr_nlp.support.values import strict_json


def _refuse(self: Any, *_: Any, **__: Any) -> Any:
    raise TypeError(f"this {type(self).__bases__[0].__name__} is read-only: make a changed copy of it")


class ReadOnlyDict(dict[str, Any]):
    """A dict that refuses to be changed; `|` makes a changed copy, an ordinary one."""

    __setitem__: Any = _refuse
    __delitem__: Any = _refuse
    __ior__: Any = _refuse
    clear: Any = _refuse
    pop: Any = _refuse
    popitem: Any = _refuse
    setdefault: Any = _refuse
    update: Any = _refuse

    def __reduce__(self) -> Any:
        return ReadOnlyDict, (dict(self),)


class ReadOnlyList(list[Any]):
    """A list that refuses to be changed."""

    __setitem__: Any = _refuse
    __delitem__: Any = _refuse
    __iadd__: Any = _refuse
    __imul__: Any = _refuse
    append: Any = _refuse
    clear: Any = _refuse
    extend: Any = _refuse
    insert: Any = _refuse
    pop: Any = _refuse
    remove: Any = _refuse
    reverse: Any = _refuse
    sort: Any = _refuse

    def __reduce__(self) -> Any:
        return ReadOnlyList, (list(self),)


def read_only(value: Any) -> Any:
    """A copy of nested dicts and lists that cannot be changed, as strict JSON has them: no arrays, no tuples."""
    plain = strict_json(value)
    if isinstance(plain, dict):
        return ReadOnlyDict({key: read_only(item) for key, item in plain.items()})
    return ReadOnlyList(map(read_only, plain)) if isinstance(plain, list) else plain
