"""Claims, and the one function that decides on them."""
