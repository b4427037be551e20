#compdef gausim
# Completion of `gausim` for zsh, written by `gausim config completion zsh`.

_gausim() {
    local -a choices open closed
    choices=("${(@f)$("${words[1]}" config complete "${(@)words[2,CURRENT]}" 2>/dev/null)}")
    choices=(${choices:#})
    if (( ! ${#choices} )); then
        _files
        return
    fi
    # After a key or a group the value follows without a space.
    open=(${(M)choices:#*[=./]})
    closed=(${choices:#*[=./]})
    (( ${#open} )) && compadd -S '' -- "${open[@]}"
    (( ${#closed} )) && compadd -- "${closed[@]}"
}

if [[ $zsh_eval_context[-1] == loadautofunc ]]; then
    _gausim "$@"
else
    compdef _gausim gausim
fi
