"""What holds for every test."""

import signal

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # pytest was started in the background: Ctrl-C would not reach the programs that tests start
    signal.signal(signal.SIGINT, signal.default_int_handler)
