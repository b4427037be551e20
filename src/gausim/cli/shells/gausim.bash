# Completion of `gausim` for bash (4.3 or newer), written by `gausim config completion bash`.

_gausim() {
    local line=${COMP_LINE:0:COMP_POINT} choice
    local -a words
    read -ra words <<<"$line"
    [[ $line == *[[:space:]] ]] && words+=("")
    local whole=${words[-1]}
    # Readline replaces only what follows the last of COMP_WORDBREAKS, to which = and : belong; the rest is typed already.
    local typed=${whole%"${whole##*[=:]}"}
    [[ $COMP_WORDBREAKS == *=* ]] || typed=
    COMPREPLY=()
    while IFS= read -r choice; do
        COMPREPLY+=("${choice#"$typed"}")
    done < <("${words[0]}" config complete "${words[@]:1}" 2>/dev/null)
    # After a key or a group the value follows without a space.
    if [[ ${#COMPREPLY[@]} -gt 0 && ${COMPREPLY[0]} == *[=./] ]]; then
        compopt -o nospace
    fi
}

complete -o default -F _gausim gausim
