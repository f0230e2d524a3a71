"""The base of every model: frozen, no unknown keys, no NaN or infinity; and the YAML that they are read from.

YAML without aliases: a few hundred bytes of aliases in aliases stand for more values than a machine can hold.
"""

from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict


class Model(BaseModel):
    """A frozen record that refuses unknown keys and numbers that are not finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)


class _Loader(yaml.SafeLoader):
    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()  # type: ignore[no-untyped-call]
            raise yaml.composer.ComposerError(
                None, None, f"the alias *{event.anchor} is not read; write out what it stands for", event.start_mark
            )
        node: yaml.Node | None = super().compose_node(parent, index)
        return node


def load_yaml(text: str) -> Any:
    """The values of a YAML document.

    Raises
    ------
    yaml.YAMLError
        It is not YAML, or holds an alias.

    Examples
    --------
    >>> load_yaml("a: [1, 2]")
    {'a': [1, 2]}
    """
    loader = _Loader(text)
    try:
        return loader.get_single_data()
    finally:
        loader.dispose()
