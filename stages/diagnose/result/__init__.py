"""Step 6: the verdict, the JSON, diagnosis.h5 and the page."""
