"""worldloop completion: commands, and the choices of every group of configs/, for bash and zsh."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
SHELLS = ("bash", "zsh")

_BASH = """_worldloop() {{
  local word="${{COMP_WORDS[COMP_CWORD]}}"
  # '=' separates words for bash; what stands before it has been typed already
  if [[ "$COMP_CWORD" -gt 1 && "$word" == "=" ]]; then word="${{COMP_WORDS[COMP_CWORD-1]}}="; fi
  if [[ "$COMP_CWORD" -gt 2 && "${{COMP_WORDS[COMP_CWORD-1]}}" == "=" ]]; then
    word="${{COMP_WORDS[COMP_CWORD-2]}}=$word"
  fi
  local all="{choices}"
  if [[ "$COMP_CWORD" -eq 1 ]]; then all="{commands}"; fi
  COMPREPLY=($(compgen -W "$all" -- "$word"))
  if [[ "$COMP_WORDBREAKS" == *=* && "$word" == *=* ]]; then COMPREPLY=("${{COMPREPLY[@]#*=}}"); fi
}}
complete -o default -F _worldloop worldloop"""


def script(shell: str, commands: Iterable[str]) -> str:
    """What a shell evaluates; zsh runs bash's by its own emulation."""
    groups = sorted(path for path in CONFIGS.iterdir() if path.is_dir() and not path.name.startswith("_"))
    choices = [f"{group.name}={path.stem}" for group in groups for path in sorted(group.glob("*.yaml"))]
    text = _BASH.format(commands=" ".join(commands), choices=" ".join(choices))
    return f"autoload -U bashcompinit && bashcompinit\n{text}" if shell == "zsh" else text
