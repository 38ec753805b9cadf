"""Plant, identification and page of the fault campaign."""
