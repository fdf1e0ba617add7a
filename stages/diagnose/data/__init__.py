"""What is known of the data: sites, and images laid over them."""
