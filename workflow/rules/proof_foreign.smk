# The second proof: random systems that lack drawn functions. Digests, and the diagnosis itself, are those of proof.smk.


localrules:
    proof_foreign,
    proof_foreign_small,


rule proof_foreign:
    input:
        "results/proof/proof_foreign/report.html",


rule proof_foreign_small:
    input:
        "results/proof/proof_foreign_small/report.html",


rule conceal_foreign:
    output:
        cases=directory("results/proof/{proof}/cases/{batch}"),
        digests="results/proof/{proof}/digests/{batch}.json",
    log:
        "results/proof/{proof}/logs/conceal/{batch}.log",
    benchmark:
        "results/proof/{proof}/benchmarks/conceal/{batch}.tsv"
    wildcard_constraints:
        proof=FOREIGN_SETS,
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("conceal_foreign.py"),
        settings=proof_settings,
    message:
        "{wildcards.proof}, batch {wildcards.batch}: drawing systems and functions"
    script:
        "../scripts/conceal_foreign.py"


rule open_foreign_keys:
    # As open_keys: keys come into being again when every diagnosis has ended, and go when the scores are known.
    input:
        digests="results/proof/{proof}/digests.json",
        verdicts=all_batches("results/proof/{proof}/verdicts/{batch}.json"),
    output:
        temp(directory("results/proof/{proof}/keys/{batch}")),
    log:
        "results/proof/{proof}/logs/open_keys/{batch}.log",
    benchmark:
        "results/proof/{proof}/benchmarks/open_keys/{batch}.tsv"
    wildcard_constraints:
        proof=FOREIGN_SETS,
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("open_foreign_keys.py"),
        settings=proof_settings,
    message:
        "{wildcards.proof}, batch {wildcards.batch}: opening the keys"
    script:
        "../scripts/open_foreign_keys.py"


rule score_foreign_batch:
    input:
        cases="results/proof/{proof}/cases/{batch}",
        opened="results/proof/{proof}/keys/{batch}",
        answers="results/proof/{proof}/verdicts/{batch}.json",
    output:
        table="results/proof/{proof}/scores/{batch}.parquet",
        csv="results/proof/{proof}/scores/{batch}.csv",
    log:
        "results/proof/{proof}/logs/score/{batch}.log",
    benchmark:
        "results/proof/{proof}/benchmarks/score/{batch}.tsv"
    wildcard_constraints:
        proof=FOREIGN_SETS,
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("score_foreign_batch.py"),
    message:
        "{wildcards.proof}, batch {wildcards.batch}: holding verdicts against keys and an oracle"
    script:
        "../scripts/score_foreign_batch.py"


rule collect_foreign_scores:
    input:
        all_batches("results/proof/{proof}/scores/{batch}.parquet"),
    output:
        table="results/proof/{proof}/tables/score.parquet",
        csv="results/proof/{proof}/tables/score.csv",
    log:
        "results/proof/{proof}/logs/collect_scores.log",
    benchmark:
        "results/proof/{proof}/benchmarks/collect_scores.tsv"
    wildcard_constraints:
        proof=FOREIGN_SETS,
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("collect_foreign_scores.py"),
    message:
        "{wildcards.proof}: collecting scores"
    script:
        "../scripts/collect_foreign_scores.py"


rule score_foreign:
    input:
        scores="results/proof/{proof}/tables/score.parquet",
    output:
        html=report(
            "results/proof/{proof}/report.html",
            caption="../report/proof.rst",
            category="Blind test of the diagnosis",
            labels={"shows": "{proof}", "kind": "page"},
        ),
        figure="results/proof/{proof}/figures/gains.svg",
        png="results/proof/{proof}/figures/gains.png",
        targets="results/proof/{proof}/tables/targets.parquet",
        csv="results/proof/{proof}/tables/targets.csv",
    log:
        "results/proof/{proof}/logs/page.log",
    benchmark:
        "results/proof/{proof}/benchmarks/page.tsv"
    wildcard_constraints:
        proof=FOREIGN_SETS,
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("foreign_page.py"),
        title=lambda wildcards: PROOF_TITLES[wildcards.proof],
        settings=proof_settings,
        command=lambda wildcards: f"snakemake --cores 2 {wildcards.proof}",
    message:
        "{wildcards.proof}: writing the report"
    script:
        "../scripts/foreign_page.py"
