"""``python -m phsi_opt.command_line`` is ``phsi-opt``."""

from phsi_opt.command_line.app import main

if __name__ == "__main__":
    main()
