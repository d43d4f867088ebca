"""The subcommands of `ctr-nlp` that serve one problem or one plan, a file each: options in, exit status out."""
