"""Metrics of runs over held-out views, regions and time."""

import sys

from dyngs.core.callable_package import CallablePackage

sys.modules[__name__].__class__ = CallablePackage
