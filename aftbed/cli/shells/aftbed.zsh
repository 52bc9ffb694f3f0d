#compdef aftbed
# Completion of aftbed in zsh.
#
# aftbed says what may stand at the cursor. The first line of its answer: how that is inserted.
_aftbed() {
    local -a answer found shown
    local line command=${(Q)words[1]}
    command=${command/#\~\//$HOME/}
    answer=("${(@f)$("$command" completion answer -- "${(@)words[2,CURRENT-1]}" "$QIPREFIX$PREFIX" 2>/dev/null)}")
    case $answer[1] in
        files) _files ;;
        folders) _files -/ ;;
        words|quoted)
            for line in "${(@)answer[2,-1]}"; do
                found+=("${line%%$'\t'*}")
                shown+=("${line/$'\t'/  -- }")
            done
            if [[ $answer[1] == quoted ]]; then
                compadd -U -Q -a found
            elif [[ "$answer" == *$'\t'* ]]; then
                compadd -l -d shown -a found
            else
                compadd -a found
            fi
            ;;
    esac
}
if [[ $funcstack[1] == _aftbed ]]; then # autoloaded from a directory of $fpath
    _aftbed "$@"
else # evaluated, behind compinit
    compdef _aftbed aftbed
fi
