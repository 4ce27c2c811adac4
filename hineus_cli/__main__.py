"""`python -m hineus_cli` is `hineus`."""

from hineus_cli.app import main

main()
