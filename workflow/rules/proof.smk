# The proof of the diagnosis: cases that conceal something, a diagnosis that cannot know what, and scores. And the
# scores of cases that somebody else made (--config cases=DIR keys=DIR).


ruleorder: score_foreign > score_proof


localrules:
    blind_test,


for name in PROOF_SETS:

    rule:
        name:
            name
        input:
            f"results/proof/{name}/report.html",
        localrule: True


rule blind_test:
    input:
        "results/blind-test/report.html",


use rule run_task as conceal with:
    # The keys end with the job; only their digests are left.
    output:
        cases=directory("results/proof/{proof}/cases/{batch}"),
        digests="results/proof/{proof}/digests/{batch}.json",
    log:
        "results/proof/{proof}/logs/conceal/{batch}.log",
    benchmark:
        "results/proof/{proof}/benchmarks/conceal/{batch}.tsv"
    params:
        **task("conceal"),
        settings=proof_settings,
        foreign=is_foreign,
    message:
        "{wildcards.proof}, batch {wildcards.batch}: concealing effects"


use rule run_task as published_digests with:
    input:
        digests=all_batches("results/proof/{proof}/digests/{batch}.json"),
    output:
        joined="results/proof/{proof}/digests.json",
    log:
        "results/proof/{proof}/logs/published_digests.log",
    benchmark:
        "results/proof/{proof}/benchmarks/published_digests.tsv"
    params:
        **task("published_digests"),
    message:
        "{wildcards.proof}: publishing the digests of all keys"


use rule run_task as blind_diagnosis with:
    # Sees cases, and that digests were published; neither keys nor the seed that they follow from.
    input:
        cases="results/proof/{proof}/cases/{batch}",
        digests="results/proof/{proof}/digests.json",
        dictionary=DICTIONARY,
    output:
        verdicts="results/proof/{proof}/verdicts/{batch}.json",
    log:
        "results/proof/{proof}/logs/blind_diagnosis/{batch}.log",
    benchmark:
        "results/proof/{proof}/benchmarks/blind_diagnosis/{batch}.tsv"
    params:
        **task("blind_diagnosis"),
    message:
        "{wildcards.proof}, batch {wildcards.batch}: diagnosing"


use rule run_task as open_keys with:
    # Keys come into being again when every diagnosis has ended, and go when the scores are known.
    input:
        digests="results/proof/{proof}/digests.json",
        verdicts=all_batches("results/proof/{proof}/verdicts/{batch}.json"),
    output:
        folder=temp(directory("results/proof/{proof}/keys/{batch}")),
    log:
        "results/proof/{proof}/logs/open_keys/{batch}.log",
    benchmark:
        "results/proof/{proof}/benchmarks/open_keys/{batch}.tsv"
    params:
        **task("open_keys"),
        settings=proof_settings,
        foreign=is_foreign,
    message:
        "{wildcards.proof}, batch {wildcards.batch}: opening the keys"


use rule run_task as score_batch with:
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
    params:
        **task("score_batch"),
        foreign=is_foreign,
    message:
        "{wildcards.proof}, batch {wildcards.batch}: holding verdicts against keys"


use rule run_task as collect_scores with:
    input:
        scores=all_batches("results/proof/{proof}/scores/{batch}.parquet"),
    output:
        table="results/proof/{proof}/tables/score.parquet",
        csv="results/proof/{proof}/tables/score.csv",
    log:
        "results/proof/{proof}/logs/collect_scores.log",
    benchmark:
        "results/proof/{proof}/benchmarks/collect_scores.tsv"
    params:
        **task("collect_scores"),
        foreign=is_foreign,
    message:
        "{wildcards.proof}: collecting scores"


use rule run_task as score_proof with:
    input:
        scores="results/proof/{proof}/tables/score.parquet",
    output:
        html=proof_page(),
        figure="results/proof/{proof}/figures/verdicts.svg",
        png="results/proof/{proof}/figures/verdicts.png",
        targets="results/proof/{proof}/tables/targets.parquet",
        csv="results/proof/{proof}/tables/targets.csv",
    log:
        "results/proof/{proof}/logs/page.log",
    benchmark:
        "results/proof/{proof}/benchmarks/page.tsv"
    params:
        **task("score_proof"),
        title=lambda wildcards: PROOF_TITLES[wildcards.proof],
        settings=proof_settings,
        command=lambda wildcards: f"snakemake --cores 2 {wildcards.proof}",
    message:
        "{wildcards.proof}: writing the report"


use rule score_proof as score_foreign with:
    output:
        html=proof_page(),
        figure="results/proof/{proof}/figures/gains.svg",
        png="results/proof/{proof}/figures/gains.png",
        targets="results/proof/{proof}/tables/targets.parquet",
        csv="results/proof/{proof}/tables/targets.csv",
    wildcard_constraints:
        proof="|".join(FOREIGN),
    params:
        **task("score_foreign"),
        title=lambda wildcards: PROOF_TITLES[wildcards.proof],
        settings=proof_settings,
        command=lambda wildcards: f"snakemake --cores 2 {wildcards.proof}",


use rule run_task as score_case with:
    input:
        card=case_file("card"),
        recordings=case_file("recordings"),
        study=case_file("study"),
        key=key_of,
        verdict="results/mismatch/{case}/verdict.json",
        system="results/mismatch/{case}/system.yaml",
    output:
        table="results/blind-test/scores/{case}.parquet",
        csv="results/blind-test/scores/{case}.csv",
    log:
        "results/blind-test/logs/score/{case}.log",
    benchmark:
        "results/blind-test/benchmarks/score/{case}.tsv"
    params:
        **task("score_case"),
        foreign=False,
        content=lambda wildcards: case_of(wildcards).content,
    message:
        "{wildcards.case}: holding the verdict against the key"


use rule collect_scores as score_cases with:
    input:
        scores=of_folder("results/blind-test/scores/{case}.parquet"),
    output:
        table="results/blind-test/tables/score.parquet",
        csv="results/blind-test/tables/score.csv",
    log:
        "results/blind-test/logs/score_cases.log",
    benchmark:
        "results/blind-test/benchmarks/score_cases.tsv"
    params:
        **task("collect_scores"),
        foreign=False,
    message:
        "collecting the scores of the blind test"


use rule score_proof as blind_page with:
    input:
        scores="results/blind-test/tables/score.parquet",
    output:
        html="results/blind-test/report.html",
        figure="results/blind-test/figures/verdicts.svg",
        png="results/blind-test/figures/verdicts.png",
        targets="results/blind-test/tables/targets.parquet",
        csv="results/blind-test/tables/targets.csv",
    log:
        "results/blind-test/logs/page.log",
    benchmark:
        "results/blind-test/benchmarks/page.tsv"
    params:
        **task("score_proof"),
        title="Blind test of the diagnosis",
        settings=None,
        command="snakemake --cores 2 blind_test --config cases=DIR keys=DIR",
    message:
        "writing the report of the blind test"
