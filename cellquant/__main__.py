"""``python -m cellquant`` is the command ``cellquant``."""

from cellquant.cli import main

main()
