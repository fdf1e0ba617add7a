"""Hidden data for `lunargr diagnose`: a second renderer (Mitsuba) and a physical sensor, apart from the program.

Nothing here imports the program: not its forward model, effects, horizon or formulas. Laws and departures from them are
written from the papers, in other functional forms than the catalogue's where it has one.
"""
