"""The subcommands of `ctr-nlp` that stay open and move a robot on a screen: options in, exit status out."""
