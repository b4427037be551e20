# Completion of `gausim` for fish, written by `gausim config completion fish`.

function __gausim_complete
    set -l words (commandline --tokenize --current-process --cut-at-cursor)
    set -l word (commandline --current-token --cut-at-cursor)
    set -l found ($words[1] config complete $words[2..-1] "$word" 2>/dev/null)
    if test (count $found) -gt 0
        printf '%s\n' $found
    else
        __fish_complete_path "$word"
    end
end

complete --command gausim --no-files --arguments '(__gausim_complete)'
