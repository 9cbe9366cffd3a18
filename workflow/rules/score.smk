# How close a run comes to exact answers, where these are known.


rule score:
    input:
        model="results/{study}/runs/{run}/model.json",
        training=of_block("train.json"),
        networks=of_block("networks.npz"),
        card=card_if_any,
    output:
        coefficients="results/{study}/runs/{run}/coefficients.parquet",
        rrmse="results/{study}/runs/{run}/rrmse.parquet",
        prediction="results/{study}/runs/{run}/prediction.parquet",
        certificates="results/{study}/runs/{run}/certificates.parquet",
        outcome="results/{study}/runs/{run}/score.json",
    log:
        "results/{study}/logs/{run}/score.log",
    benchmark:
        "results/{study}/benchmarks/{run}/score.tsv"
    conda:
        "../envs/siq.yaml"
    threads: 1
    params:
        code=code("score.py"),
        settings=settings_of(ScoreSettings),
        card=card_says,
        exact=exact_answer,
    message:
        "{wildcards.study}, run {wildcards.run}: scoring"
    script:
        "../scripts/score.py"
