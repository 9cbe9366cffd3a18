# What the rules of the proofs share: sets of cases, their batches and keys.
import siq
from benchmarks.proof.batches import FOREIGN, load_proofs

DICTIONARY = str(Path(siq.__file__).parent / "diagnosis" / "mechanisms.yaml")

with bad_input_told():
    PROOF_SETS = load_proofs(config_path("proof.yaml"))

PROOF_TITLES = {
    "proof": "Proof of the diagnosis",
    "proof_full": "Proof of the diagnosis, all cases",
    "proof_foreign": "Proof of the diagnosis on random systems",
    "proof_foreign_small": "Proof of the diagnosis on random systems, a few cases",
}


def proof_settings(wildcards):
    """Params function: everything that a set of cases follows from, its seed included."""
    return PROOF_SETS[wildcards.proof].model_dump(mode="json")


def is_foreign(wildcards):
    """Params function: whether a set is of the second generator."""
    return wildcards.proof in FOREIGN


def proof_page():
    """The page of a set of cases, as Snakemake's own report lists it."""
    return report(
        "results/proof/{proof}/report.html",
        caption="../report/proof.rst",
        category="Blind test of the diagnosis",
        labels={"shows": "{proof}", "kind": "page"},
    )


def all_batches(pattern):
    """Input function: one file for every batch of the set."""
    return lambda wildcards: expand(
        pattern,
        proof=wildcards.proof,
        batch=PROOF_SETS[wildcards.proof].batch_names(),
    )


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


wildcard_constraints:
    proof="|".join(PROOF_SETS),
    batch="[0-9]+",
