"""Random elastic bodies for a corpus: shapes, materials, pins, pushes and two simulators."""
