"""``covrecon completion``: what the shell needs to complete our commands; made from them, so never out of date."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Literal

from cyclopts import App

Shell = Literal["bash", "zsh", "fish"]


def completion_of(app: App) -> Callable[[Shell], None]:
    """The command for all that ``app`` offers by the time it is called."""

    def completion(shell: Shell, /) -> None:
        """Print a script that completes commands, options and their values when TAB is pressed.

        It starts no Python. Write it to where your shell looks for it, once:

        ```
        covrecon completion bash > ~/.local/share/bash-completion/completions/covrecon
        covrecon completion zsh > ~/.zsh/completions/_cyclopts_covrecon   # a folder in $fpath
        covrecon completion fish > ~/.config/fish/completions/covrecon.fish
        ```

        or, for this shell alone:

        ```
        source <(covrecon completion bash)
        ```
        """
        sys.stdout.write(app.generate_completion(shell=shell))

    return completion
