"""Interfaces of all kinds of model: `Renderable`, `Model`, `Loss`, `ModelKind` and its registry.

``renderable``: scenes that can be rendered. ``model``: models in training and loss terms.
``prediction``: networks that predict scenes. ``kind``: creates and restores models from the config.
"""
