/* Runs so many control steps of the image that is linked in, with random observations, and prints a hash of the bits of the actions.
 * usage: steps <number of steps> [portable]     portable: with the kernels of arrays alone
 * count.c counts the instructions of two runs; their difference is that of the steps by which they differ. */
#include <lads.h>
#include <stdio.h>
#include <stdlib.h>

enum { WORKSPACE_BYTES = 8 << 20, OBSERVATION_MOST = 256, ACTION_MOST = 64 };

extern const unsigned char IMAGE[IMAGE_BYTES];

static lads_policy policy;
static _Alignas(LADS_WORKSPACE_ALIGN) unsigned char workspace[WORKSPACE_BYTES];

int main(int count, char **arguments) {
    if (count < 2) {
        fprintf(stderr, "usage: steps <number of steps> [portable]\n");
        return 2;
    }
    const long steps = strtol(arguments[1], NULL, 10);
    const _Bool portable = count > 2;
    lads_options options = {.struct_bytes = sizeof options,
                            .flags = LADS_ARM_WITHOUT_SELF_TEST | (portable ? LADS_PORTABLE_INSTRUCTIONS : 0)};
    lads_contract contract = {.struct_bytes = sizeof contract};
    lads_element element = {.struct_bytes = sizeof element};
    lads_controller *controller;
    lads_status status = lads_policy_open(IMAGE, IMAGE_BYTES, &policy);
    if (status == LADS_STATUS_OK) {
        status = lads_controller_init(&policy, workspace, sizeof workspace, &options, &controller, NULL);
    }
    if (status == LADS_STATUS_OK) {
        status = lads_set_instruction(controller, 0);
    }
    if (status == LADS_STATUS_OK) {
        status = lads_policy_contract(&policy, &contract);
    }
    if (status != LADS_STATUS_OK || contract.observation_len > OBSERVATION_MOST || contract.action_len > ACTION_MOST) {
        fprintf(stderr, "steps: %s\n", lads_status_text(status));
        return 1;
    }
    float observation[OBSERVATION_MOST], action[ACTION_MOST];
    uint32_t hash = 2166136261u, random = 1;
    for (long step = 0; step < steps; step++) {
        for (size_t i = 0; i < contract.observation_len; i++) {
            lads_channel_element(&policy, contract.observation, i, &element);
            random = random * 1664525u + 1013904223u;
            const float share = (float)(random >> 16) / 65536.0f;
            const float width = element.max - element.min;
            const float part = width * share;
            observation[i] = element.min + part;
        }
        status = lads_step(controller, observation, contract.observation_len, NULL, action, contract.action_len, NULL);
        if (status != LADS_STATUS_OK) {
            fprintf(stderr, "steps: step %ld: %s\n", step, lads_status_text(status));
            return 1;
        }
        for (size_t i = 0; i < contract.action_len; i++) {
            union { float value; uint32_t bits; } word = {.value = action[i]};
            hash = (hash ^ word.bits) * 16777619u;
        }
    }
    printf("actions %08x\n", hash);
    return 0;
}
