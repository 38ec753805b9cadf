"""Where people meet the tool: command line, report, page."""
