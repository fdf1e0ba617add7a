"""Step 3: what the rows say of every effect."""
