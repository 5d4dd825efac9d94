"""``python -m phsi_opt.command_line`` is ``phsi-opt``."""


def main() -> None:
    """The entry point ``phsi-opt``."""
    # Here, because the working process imports this file too.
    from phsi_opt.command_line import app

    app.main()


if __name__ == "__main__":
    main()
