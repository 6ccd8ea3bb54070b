"""The quantised scene file `scene.dyngs`."""
