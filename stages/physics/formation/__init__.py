"""How an image comes to be, from terrain to detector."""
