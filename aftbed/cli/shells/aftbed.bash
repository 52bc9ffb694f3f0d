# Completion of aftbed in bash (4.4 or later).
#
# aftbed says what may stand at the cursor. The first line of its answer: how that is inserted.
_aftbed() {
    local current=${COMP_WORDS[COMP_CWORD]} command=${COMP_WORDS[0]} answer hidden=(-X '.*')
    case $command in \~/*) command=$HOME/${command#??} ;; esac
    case $current in .*) hidden=() ;; esac
    COMPREPLY=()
    mapfile -t answer < <("$command" completion answer -- "${COMP_WORDS[@]:1:COMP_CWORD}" 2>/dev/null)
    case ${answer[0]} in
        files) compopt -o default ;;
        folders)
            compopt -o filenames
            mapfile -t COMPREPLY < <(compgen -d "${hidden[@]}" -- "$current")
            ;;
        words | quoted) COMPREPLY=("${answer[@]:1}") COMPREPLY=("${COMPREPLY[@]%%$'\t'*}") ;;
    esac
}
complete -F _aftbed aftbed
