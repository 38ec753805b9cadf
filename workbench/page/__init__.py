"""The page in the browser: a server on the loopback interface and what its views ask for."""
