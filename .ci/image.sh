#!/usr/bin/env bash
# Build the image of the Dockerfile and try it out: as a user without a name and a home, on a mounted folder.
# ENGINE=docker, podman or buildah; BUILD_OPTIONS=... for `build`, such as --build-arg BASE=... where no registry is reached.
set -euo pipefail
cd "$(dirname "$0")/.."

IMAGE=${IMAGE:-hineus}
SOMEBODY=12345:12345

say() { printf '%s\n' "image: $*" >&2; }

find_engine() {
    local candidate
    for candidate in ${ENGINE:-docker podman buildah}; do
        # buildah needs no service; the client of docker may be there without one
        if command -v "$candidate" >/dev/null && { [ "$candidate" = buildah ] || "$candidate" info >/dev/null 2>&1; }; then
            echo "$candidate"
            return 0
        fi
    done
    say "none of docker, podman and buildah works here"
    exit 1
}

# run_in FOLDER ARGUMENTS...: hineus with the folder at /data
run_in() {
    local folder=$1
    shift
    if [ "$engine" = buildah ]; then
        local container
        container=$(buildah from "$IMAGE")
        buildah run --user "$SOMEBODY" --env HOME=/ -v "$folder:/data" "$container" -- hineus "$@" || return $?
        buildah rm "$container" >/dev/null
    else
        "$engine" run --rm --user "$SOMEBODY" --volume "$folder:/data" "$IMAGE" "$@"
    fi
}

engine=$(find_engine)
say "building with $engine"
# shellcheck disable=SC2086 # several words on purpose
"$engine" build ${BUILD_OPTIONS:-} -t "$IMAGE" .
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
chown "$SOMEBODY" "$folder"
run_in "$folder" doctor
run_in "$folder" demo --preset tiny -w demo
owner=$(stat -c %u:%g "$folder/demo/workspace/export/model.glb")
[ "$owner" = "$SOMEBODY" ] || { say "the model belongs to $owner instead of $SOMEBODY"; exit 1; }
say "it works: $(stat -c %s "$folder/demo/workspace/export/model.glb") bytes of model, of $owner"
