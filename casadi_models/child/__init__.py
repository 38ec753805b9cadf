"""Foreign code and foreign files in a process of their own, before this process meets them."""
