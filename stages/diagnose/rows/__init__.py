"""Step 2: residuals and what effects would add to them, as rows of one linear model, piece of ground by piece of ground."""
