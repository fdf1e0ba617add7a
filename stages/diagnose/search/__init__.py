"""Step 4: name one effect after the other, rendering again with every one that was named."""
