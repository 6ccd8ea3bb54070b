"""Capture readers, one module per layout. Each defines a ``FORMAT``; ``dyngs.data.read`` lists
them."""
