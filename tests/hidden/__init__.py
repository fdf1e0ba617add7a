"""Hidden data for `lunargr diagnose`: a second renderer (Mitsuba) and a physical sensor, apart from the forward model.

Nothing here imports the forward model, the effects or the program's horizon. The one formula taken over is Hapke's
roughness, from ``stages.physics.photometry.roughness``, because ``theta_bar_deg`` is defined by it.
"""
