# Completion of aftbed in fish.
#
# aftbed says what may stand at the cursor. The first line of its answer: how that is inserted.
function __aftbed_complete
    set -l before (commandline --cut-at-cursor --tokenize --current-process)
    set -l current (commandline --cut-at-cursor --current-token)
    set -l answer ($before[1] completion answer -- $before[2..-1] "$current" 2>/dev/null)
    switch "$answer[1]"
        case files
            __fish_complete_path "$current"
        case folders
            __fish_complete_directories "$current"
        case words quoted
            string replace --regex '^"' '' -- $answer[2..-1] # fish quotes by itself
    end
end
complete --command aftbed --no-files --arguments '(__aftbed_complete)'
