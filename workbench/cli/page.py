"""app: the page in the browser."""

from __future__ import annotations

from argparse import Namespace

from identification.errors import InputError


def run_app(arguments: Namespace) -> int:
    """`irj app`."""
    try:
        from workbench.page.server import serve
    except ImportError as error:
        raise InputError(
            f"the page needs {(error.name or 'starlette').partition('.')[0]}; install it with: "
            "pip install 'irj[app]'"
        ) from None
    serve(arguments.files, arguments.port, not arguments.no_browser, follow=arguments.follow)
    return 0
