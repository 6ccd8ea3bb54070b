"""A scene as one HTML file that plays in a browser by itself: the page, its program and its
numbers.

The page draws with WebGL 2 and moves the Gaussians itself. ``page.html``, ``page.css``, the
``*.js`` and the ``*.glsl`` next to this file are put into it as they are.
"""
