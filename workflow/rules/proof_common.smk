# Helpers of the rules of the proof: its sets and batches, and cases that somebody else made.
from workflow.proof.sets import FOREIGN, load_proofs

try:
    PROOF_SETS = load_proofs(config_path("proof.yaml"))
except InputError as error:
    say_and_stop(error)

# Sets of the first generator, and of the second; the pattern of none of them matches nothing.
OWN_SETS, FOREIGN_SETS = (
    "|".join(name for name in PROOF_SETS if (name in FOREIGN) == foreign) or "(?!)"
    for foreign in (False, True)
)

PROOF_TITLES = {
    "proof": "Proof of the diagnosis",
    "proof_full": "Proof of the diagnosis, all cases",
    "proof_foreign": "Proof of the diagnosis on random systems",
    "proof_foreign_small": "Proof of the diagnosis on random systems, a few cases",
}


def proof_settings(wildcards):
    """Params function: everything that a set of cases follows from, its seed included."""
    return PROOF_SETS[wildcards.proof].model_dump(mode="json")


def all_batches(pattern):
    """Input function: one file for every batch of the set."""
    return lambda wildcards: expand(
        pattern,
        proof=wildcards.proof,
        batch=PROOF_SETS[wildcards.proof].batch_names(),
    )


def blind_names():
    """Names of the cases that somebody else made."""
    try:
        return CASES.in_folder()
    except InputError as error:
        say_and_stop(error)


def key_of(wildcards):
    """Input function: the key of a case that somebody else made, with its arrays where there are any."""
    folder = config.get("keys")
    if folder is None:
        say_and_stop(
            "--config, keys: no folder is given; write --config cases=DIR keys=DIR."
        )
    names = (Path(folder) / f"{wildcards.case}.{kind}" for kind in ("json", "npz"))
    found = [str(path) for path in names if path.is_file()]
    if not found or not found[0].endswith(".json"):
        say_and_stop(
            f"{folder}, {wildcards.case}.json: the case has no key; add it, or take the case away."
        )
    return found


def all_blind_scores(wildcards):
    """Input function: the score of every case of the folder."""
    return expand("results/blind-test/scores/{case}.parquet", case=blind_names())
