"""The desk: the tree of fits of a session, and the sessions of a user."""
