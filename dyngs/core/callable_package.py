"""Packages that are also functions of ``dyngs``."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any


class CallablePackage(ModuleType):
    """A package that is called like the function of its name: ``dyngs.evaluate``.

    The import of such a package would otherwise hide the function.
    """

    @property
    def __wrapped__(self) -> Any:
        """The function, whose signature and docstring ``help`` shows."""
        package, _, name = self.__name__.partition(".")
        return sys.modules[package].__getattr__(name)

    @property
    def __doc__(self) -> Any:
        return self.__wrapped__.__doc__

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self.__wrapped__(*args, **kwargs)
