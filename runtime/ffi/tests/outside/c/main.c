/* A C99 program of a user of the installed library: opens an image, tests it, drives a few steps, in memory of its own.
 * usage: user IMAGE; exits with the number of what failed, 0 for nothing. */
#include <lads.h>

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

/* Memory from malloc that starts on a line; never freed, the program ends soon. */
static void *lines(size_t bytes) {
    unsigned char *memory = malloc(bytes + LADS_WORKSPACE_ALIGN);
    return memory == NULL ? NULL : memory + (LADS_WORKSPACE_ALIGN - (uintptr_t)memory % LADS_WORKSPACE_ALIGN);
}

static int fail(const char *what, lads_status status) {
    fprintf(stderr, "%s: %s\n", what, lads_status_text(status));
    return 1;
}

int main(int count, char **arguments) {
    static lads_policy policy;
    lads_contract contract = {.struct_bytes = sizeof contract};
    lads_element element = {.struct_bytes = sizeof element};
    lads_counters_t counters = {.struct_bytes = sizeof counters};
    lads_self_test_t tested = {.struct_bytes = sizeof tested};
    lads_controller *controller;

    if (count != 2 || lads_abi_version() != LADS_ABI_VERSION) {
        return 2;
    }
    FILE *file = fopen(arguments[1], "rb");
    if (file == NULL || fseek(file, 0, SEEK_END) != 0) {
        return 3;
    }
    const size_t bytes = (size_t)ftell(file);
    unsigned char *image = lines(bytes);
    rewind(file);
    if (image == NULL || fread(image, 1, bytes, file) != bytes) {
        return 4;
    }
    fclose(file);

    lads_status status = lads_policy_open(image, bytes, &policy);
    if (status != LADS_STATUS_OK) {
        return fail("open", status);
    }
    if ((status = lads_policy_contract(&policy, &contract)) != LADS_STATUS_OK) {
        return fail("contract", status);
    }
    printf("%.*s, every %g s\n", (int)contract.environment.len, contract.environment.data, (double)contract.control_period_s);
    for (size_t i = 0; i < contract.action_len; i++) {
        if ((status = lads_channel_element(&policy, contract.action, i, &element)) != LADS_STATUS_OK) {
            return fail("action", status);
        }
        printf("  %.*s [%.*s] %g to %g\n", (int)element.name.len, element.name.data, (int)element.unit.len,
               element.unit.data, (double)element.min, (double)element.max);
    }

    void *workspace = lines(lads_workspace_bytes(&policy));
    float *observation = calloc(contract.observation_len, sizeof *observation);
    float *action = calloc(contract.action_len, sizeof *action);
    if (workspace == NULL || observation == NULL || action == NULL) {
        return 5;
    }
    const lads_options options = {.struct_bytes = sizeof options, .fallback = LADS_FALLBACK_HOLD};
    status = lads_controller_init(&policy, workspace, lads_workspace_bytes(&policy), &options, &controller, NULL);
    if (status != LADS_STATUS_OK) {
        return fail("init", status);
    }
    if ((status = lads_self_test(controller, &tested)) != LADS_STATUS_OK) {
        return fail("self-test", status);
    }
    if ((status = lads_set_instruction(controller, 0)) != LADS_STATUS_OK) {
        return fail("instruction", status);
    }
    for (size_t i = 0; i < contract.observation_len; i++) {
        lads_channel_element(&policy, contract.observation, i, &element);
        observation[i] = element.min + (element.max - element.min) / 2;
    }
    for (uint64_t t = 1; t <= 100; t++) {
        const lads_tick tick = {.struct_bytes = sizeof tick, .timestamp = t};
        status = lads_step(controller, observation, contract.observation_len, &tick, action, contract.action_len, NULL);
        if (status != LADS_STATUS_OK) {
            return fail("step", status);
        }
    }
    if (lads_step(controller, NULL, 0, NULL, action, contract.action_len, NULL) != LADS_STATUS_NO_OBSERVATION) {
        return 6;
    }
    lads_counters(controller, &counters);
    printf("self-test within %g, %d steps, %d fallback\n", (double)tested.largest_error, (int)counters.policy,
           (int)counters.no_observation);
    free(observation);
    free(action);
    return counters.periods == 101 ? 0 : 7;
}
