"""`lunargr diagnose`."""
