"""Export of a scene as a self-contained HTML page that plays in a browser.

The page renders with WebGL 2 and moves the Gaussians itself. ``page.html``, ``page.css``, the
``*.js`` and the ``*.glsl`` files in this folder are inlined.
"""
