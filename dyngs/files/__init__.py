"""Files on disk, safely: untrusted ones read within limits, our own written whole or not at all."""
