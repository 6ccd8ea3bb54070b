"""Colour that costs only what it shows: a shared network in place of harmonics, and harmonics only
where they pay."""
