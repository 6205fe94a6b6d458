"""Completion of words in a shell."""

from collections.abc import Mapping, Sequence

SCRIPT = """COMP_WORDBREAKS=${{COMP_WORDBREAKS//=/}}
_dds() {{
    local word="${{COMP_WORDS[COMP_CWORD]}}" known
    case "${{COMP_WORDS[*]:1:COMP_CWORD-1}} " in
{cases}
    *) known="" ;;
    esac
    COMPREPLY=($(compgen -W "$known" -- "$word"))
    [[ "${{COMPREPLY[0]}}" == *= ]] && compopt -o nospace 2>/dev/null
    return 0
}}
complete -o default -F _dds dds"""
ZSH = "autoload -U +X bashcompinit && bashcompinit\n"


def script(words: Mapping[str, Sequence[str]], zsh: bool) -> str:
    """What a shell has to read.

    Args:
        words: Command, its words joined, to what may follow; "" stands for none.
        zsh: Whether the shell is zsh, which has a bridge to what bash understands.
    """
    # The longest first: `data ` would match `data list ` too.
    paths = sorted(filter(None, words), key=len, reverse=True)
    lines = [f'    "{path} "*) known="{" ".join(words[path])}" ;;' for path in paths]
    lines.append(f'    " ") known="{" ".join(words[""])}" ;;')
    return (ZSH if zsh else "") + SCRIPT.format(cases="\n".join(lines))
