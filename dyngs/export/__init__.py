"""Export of images, videos, Gaussians, meshes and web pages; camera paths; scene edits."""

import sys

from dyngs.core.callable_package import CallablePackage

sys.modules[__name__].__class__ = CallablePackage
