# What the Slurm scripts share: every job is checked before the first is submitted, and waits for the one before it.
: "${LUNARGR:=lunargr}" "${CPUS:=4}" "${MEM:=8G}" "${TIME:=02:00:00}" "${SBATCH_OPTIONS:=}" "${DRY_RUN:=}"
last=${AFTER:-} # the job that the next one waits for
checking=

# submit_all PATH COMMAND...: run COMMAND, which submits jobs that make PATH or files below it; nothing is submitted
# where Slurm refuses one of them, or where such jobs are in the queue already
submit_all() {
    local path queued='' job made
    path=$(realpath -m "$1")
    shift
    if [ -z "$DRY_RUN" ]; then
        while read -r job made; do
            case $made in "lunargr $path" | "lunargr $path/"*) queued+=" $job" ;; esac
        done < <(squeue --noheader --format='%F %k' | sort -u)
        if [ -n "$queued" ]; then
            echo "$path: expected no job for it in the queue, found$queued; wait for them, or cancel them: scancel$queued" >&2
            exit 1
        fi
        checking=1
        "$@"
    fi
    checking='' last=${AFTER:-}
    "$@"
}

# submit OUTPUT SBATCH_WORDS...: a job that makes OUTPUT after the job `last`, and becomes `last`
submit() {
    local extra words said
    words=(sbatch --parsable --requeue --comment="lunargr $(realpath -m "$1")")
    shift
    read -r -a extra <<<"$SBATCH_OPTIONS"
    words+=(${extra[@]+"${extra[@]}"})
    [ -z "$last$checking" ] || words+=(--kill-on-invalid-dep=yes)
    if [ -n "$checking" ]; then
        said=$("${words[@]}" --test-only "$@" 2>&1) && return
        echo "$said" >&2
        echo "nothing was submitted; Slurm refuses the job with: ${*%%$'\n'*}" >&2
        exit 1
    fi
    [ -z "$last" ] || words+=(--dependency="afterok:$last")
    if [ -n "$DRY_RUN" ]; then
        printf '%q ' "${words[@]}" "$@" >&2
        echo >&2
        last=12345
    else
        last=$("${words[@]}" "$@")
        last=${last%%;*} # on several clusters the name of one follows
    fi
}

# one OUTPUT STAGE ARGUMENTS...: a single job, unless its output is there
one() {
    local output=$1
    shift
    [ -e "$output" ] && return
    submit "$output" --job-name="lunargr-$1" --cpus-per-task="$CPUS" --mem="$MEM" --time="$TIME" --wrap "$(task "$output" "$@")"
}

# wide OUTPUT SHARDS STAGE ARGUMENTS...: an array of shards and a job that merges them, unless the output is there
wide() {
    local output=$1 count=$2 part parts='' i
    shift 2
    [ -e "$output" ] && return
    part=$(printf %q "${output%.h5}")
    for ((i = 1; i <= count; i++)); do parts+="$part.$i-of-$count.h5 "; done
    submit "$output" --job-name="lunargr-$1" --array="1-$count" --cpus-per-task="$CPUS" --mem="$MEM" --time="$TIME" \
        --wrap "part=$part.\$SLURM_ARRAY_TASK_ID-of-$count.h5
$(task '' "$@") --shard \$SLURM_ARRAY_TASK_ID/$count"
    submit "$output" --job-name="lunargr-merge-$1" --cpus-per-task=1 --mem="$MEM" --time="$TIME" \
        --wrap "$(task "$output" merge) $parts
rm -f $parts"
}

# task OUTPUT STAGE ARGUMENTS...: the lines of a job; what exists is not made again. OUTPUT: '' for the variable `part`
task() {
    local output='"$part"'
    [ -z "$1" ] || output=$(printf %q "$1")
    shift
    echo "set -eu
export OMP_NUM_THREADS=\${SLURM_CPUS_PER_TASK:-1} NUMBA_NUM_THREADS=\${SLURM_CPUS_PER_TASK:-1}
[ -e $output ] || $LUNARGR $(printf '%q ' "$@")--output $output"
}
