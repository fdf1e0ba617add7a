"""Step 0: the nominal model, rendered site by site."""
