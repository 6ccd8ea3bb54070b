"""Files of weights that `dyngs predict` finds by their names. They were trained on synthetic people alone."""
