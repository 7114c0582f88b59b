"""Properties that are computed once, by several threads at a time."""

from collections.abc import Callable
from typing import Any, Generic, TypeVar

T = TypeVar("T")


class once(Generic[T]):
    """A property that is computed when it is first asked for, and kept with the object.

    `functools.cached_property` of Python 3.11 has one lock for all objects of a class: threads that
    compute it for different objects wait for each other. Here two threads that ask the same object
    at once may both compute it.
    """

    def __init__(self, function: Callable[[Any], T]):
        self.function, self.__doc__ = function, function.__doc__

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, instance: Any, owner: type) -> T:
        value = self.function(instance)
        # A value in the object's own dictionary goes before a descriptor without __set__.
        instance.__dict__[self.name] = value
        return value
