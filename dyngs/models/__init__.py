"""Interfaces of all kinds of model: `Renderable`, `Model`, `Loss`, `ModelKind` and its registry.

``renderable``: what can be drawn from anywhere at any time. ``model``: what a trainer steps, loss
terms. ``prediction``: networks that predict scenes, ``convolution``: what they share. ``kind``: a
section of the configuration, and what begins and restores its model.
"""
